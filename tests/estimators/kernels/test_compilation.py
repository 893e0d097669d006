"""Who does not make a particle filter does not wait for the compiler, and no one waits twice."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from estimators import kernels
from estimators.kernels import likelihood, scan_fit
from estimators.kernels.compilation import sources_of

MODULES = [import_module(f"estimators.kernels.{found.name}") for found in iter_modules(kernels.__path__)]
COMPILED = [getattr(module, name) for module in MODULES for name in dir(module)]


def test_neither_the_command_line_nor_the_table_of_estimators_loads_numba() -> None:
    code = (
        "import sys, companion.cli, estimators, companion.config; companion.config.default_toml();"
        "assert 'numba' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_kernels_are_compiled_when_loaded_and_kept_on_disk() -> None:
    functions = {f for f in COMPILED if hasattr(f, "signatures") and f.signatures}
    assert len(functions) >= 15
    for kernel in functions:
        # One signature, stated beforehand: no call can start the compiler.
        assert len(kernel.signatures) == 1
        assert kernel.stats.cache_path


def test_a_second_process_compiles_nothing() -> None:
    code = (
        "from estimators.kernels import cloud, likelihood, motion, posterior, scan\n"
        "assert not posterior.sample.stats.cache_misses, posterior.sample.stats\n"
        "assert posterior.sample.stats.cache_hits"
    )
    root = Path(__file__).parents[3]
    subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=root, env={**os.environ, "PYTHONPATH": str(root)}
    )


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed_and_only_then() -> None:
    loaded = {name: module for name, module in sys.modules.items() if name.startswith("estimators.kernels.")}
    calls = 0
    for name, module in loaded.items():
        known = sources_of(name)
        for other in {str(getattr(f, "__module__", "")) for f in vars(module).values()} & loaded.keys():
            calls += other != name
            assert Path(str(loaded[other].__file__)).read_text() in known
    assert calls > 10
    assert Path(str(likelihood.__file__)).read_text() not in sources_of(scan_fit.__name__)
