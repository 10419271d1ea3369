"""Dynamics Mapping: world models for visual imitation learning, supervised on the dynamics of the scene.

The parts (``envs``, ``modules``, ``objectives``, ``data``, ``experts``, ``evaluation``) are imported when first used, and
the Gymnasium ids registered when Gymnasium is, before or after this package: importing it alone takes no time.
"""

import importlib
import sys

__version__ = "0.1.0"
__all__ = ["data", "envs", "evaluation", "experts", "modules", "objectives"]

GYMNASIUM_IDS = {
    "dynmap_rl/BalanceReaching-v0": "balance_reaching",
    "dynmap_rl/BalanceReachingObstacle-v0": "balance_reaching_obstacle",
    "dynmap_rl/BinDropping-v0": "bin_dropping",
}


def __getattr__(name: str):
    if name in __all__:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "GYMNASIUM_IDS", "__version__"]


def _register(gymnasium) -> None:
    for name, task in GYMNASIUM_IDS.items():
        gymnasium.register(name, "dynmap_rl.envs.gymnasium_env:DynmapEnv", kwargs={"task": task})


class _RegisterWithGymnasium:
    """Finds Gymnasium as the finders after it do, and registers the ids once it is imported.

    Gymnasium (1.4) has no entry points by which a package could name its ids, and importing it here would take 0.4 s
    of every start. An import that fails leaves this in place: the next may succeed.
    """

    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name != "gymnasium":
            return None
        others = sys.meta_path[sys.meta_path.index(cls) + 1 :]
        spec = next((spec for finder in others if (spec := finder.find_spec(name, path))), None)
        if spec:
            execute = spec.loader.exec_module

            def execute_and_register(module):
                execute(module)
                _register(module)
                if cls in sys.meta_path:
                    sys.meta_path.remove(cls)

            spec.loader.exec_module = execute_and_register
        return spec


if "gymnasium" in sys.modules:
    _register(sys.modules["gymnasium"])
else:
    sys.meta_path.insert(0, _RegisterWithGymnasium)
