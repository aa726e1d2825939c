"""truearm: measure where a robot arm really is, identify its kinematic parameters, correct it.

``__init__.pyi`` lists the public interface (docs/reference/api.md), for type checkers and for this module. Each name is
imported on first use, so ``import truearm`` is cheap.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

from truearm.version import VERSION as __version__

_IMPORTS = re.findall(
    r"^from truearm\.([\w.]+) import (\w+) as \2$", Path(__file__).with_suffix(".pyi").read_text("utf-8"), re.MULTILINE
)
_MODULES = {name: module for module, name in _IMPORTS}
__all__ = [*sorted(_MODULES), "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"truearm.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
