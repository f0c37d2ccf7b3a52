"""motionlab: a thin library for studying human motion priors.

Modules are imported when they are first used: ``from motionlab import io, retarget`` costs what these two cost, and
``import motionlab`` nothing. docs/library.md says what is where.
"""

from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

__version__ = "0.1.0"
__all__ = [module.name for module in iter_modules(__path__) if module.name != "__main__"]


def __getattr__(name: str) -> ModuleType:
    if name in __all__:
        return import_module(f"motionlab.{name}")
    raise AttributeError(f"module 'motionlab' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
