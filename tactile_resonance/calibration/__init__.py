# SPDX-License-Identifier: Apache-2.0
"""The sensor's own parameters, and what a contact is once they are known."""
