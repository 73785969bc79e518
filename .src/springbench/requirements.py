"""Requirements of a light installation: all but Rerun, PyVista and VTK, which take a gigabyte.

python -m pip install --no-deps springbench
python -m springbench.requirements >light.txt
python -m pip install -r light.txt

`python -m pip install "springbench[record]"` completes it later.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.metadata import requires

LIGHT_EXTRAS = ("record", "pictures")
"""Extras whose libraries are left out, although they are dependencies of the package too."""


def list_light_requirements(lines: Iterable[str]) -> list[str]:
    """List the requirements of the package without those of LIGHT_EXTRAS and of other extras.

    Args:
        lines: requirements of the package, as its metadata state them.

    Returns:
        The lines of the other requirements, for `pip install -r`.
    """
    left_out, needed = set[str](), dict[str, str]()
    for line in lines:
        name, extra = re.split(r"[^\w.-]", line, maxsplit=1)[0], re.search(r"extra == ['\"]([\w-]+)", line)
        if extra is None:
            needed[name] = line
        elif extra[1] in LIGHT_EXTRAS:
            left_out.add(name)
    return [line for name, line in needed.items() if name not in left_out]


if __name__ == "__main__":
    print("\n".join(list_light_requirements(requires("springbench") or ())))
