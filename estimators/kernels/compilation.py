"""How kernels are compiled."""

import re
import sys
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., object])

MATRIX, VECTOR, INDICES = "float64[:, ::1]", "float64[::1]", "int64[::1]"
KERNELS = re.compile(r"^from (\w+\.kernels\.\w+) import", re.MULTILINE)
"""What a module of kernels says of the others that it calls."""


@cache
def sources_of(module: str) -> frozenset[str]:
    """Source texts of a loaded module of kernels and of those that it calls."""
    source = Path(str(sys.modules[module].__file__)).read_text()
    return frozenset({source}).union(*map(sources_of, KERNELS.findall(source)))


def compiled(signature: str) -> Callable[[Function], Function]:
    """Compile for these types when the module is loaded, not when the robot already walks.

    What is kept on disk is known by the function's name and the age of its file, but not of the files of what
    it calls. So the name is given a digest of its module and of those that it calls.
    """

    def compile_or_load(function: Function) -> Function:
        sources = "".join(sorted(sources_of(function.__module__)))
        function.__qualname__ += f"_{sha256(sources.encode()).hexdigest()[:8]}"
        return cast("Function", njit(signature, cache=True, error_model="numpy")(function))

    return compile_or_load


inlined = cast("Callable[[Function], Function]", njit(inline="always", error_model="numpy"))
"""Decorator of what is compiled into the functions that call it."""
