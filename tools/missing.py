# SPDX-License-Identifier: Apache-2.0
"""Print what a requirements file asks for beyond what the interpreter that runs this sees.

As JSON: `missing`, the requirements not met; `present`, all distributions and their versions.
"""

import json
import re
import sys
from importlib.metadata import distributions

from pip._vendor.packaging.requirements import Requirement


def normalised(name: str) -> str:
    """The name of a distribution as indexes spell it."""
    return re.sub("[-_.]+", "-", name).lower()


# The first of a name is the one that is imported.
present: dict[str, str] = {}
for distribution in distributions():
    present.setdefault(normalised(distribution.metadata["Name"] or ""), distribution.version)

missing = []
with open(sys.argv[1]) as requirements:
    for line in requirements:
        if text := line.partition("#")[0].strip():
            wanted = Requirement(text)
            version = present.get(normalised(wanted.name))
            if version is None or not wanted.specifier.contains(version, prereleases=True):
                missing.append(text)

print(json.dumps({"missing": missing, "present": present}))
