# SPDX-License-Identifier: Apache-2.0
"""From sampled periods to the frequency response function with its covariance.

In the order in which a record goes through them: `spectra` (one transform, read by all that follows),
`excited` (which lines), `local_polynomial` (means without the transient, noise), `estimate` and
`result` (the FRF), `distortion`, `faults`, `skew`; `band_bins` for the joint estimator of poles;
`measurement` for records that come in one after the other; `variance_analysis` over many FRFs.
"""
