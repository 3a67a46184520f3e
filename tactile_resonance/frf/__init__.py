# SPDX-License-Identifier: Apache-2.0
"""From sampled periods to the frequency response function with its covariance.

In the order in which a record goes through them: `spectra` (one transform, read by all that follows; means
without the transient, noise), `excited` (which lines), `estimate` and `result` (the FRF, and all bins of a band
for the joint estimator of poles), `distortion`, `faults`, `skew`; `measurement` for records that come in one
after the other; `variance_analysis` over many FRFs.
"""
