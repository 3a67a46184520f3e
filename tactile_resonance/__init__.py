# SPDX-License-Identifier: Apache-2.0
# Only the namespace line: it lets the source tree find the messages generated into an installed tree.
__path__ = __import__("pkgutil").extend_path(__path__, __name__)
