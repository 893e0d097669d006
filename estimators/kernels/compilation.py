"""How kernels are compiled."""

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., object])

MATRIX, VECTOR, INDICES = "float64[:, ::1]", "float64[::1]", "int64[::1]"


def _digest_of_kernels() -> str:
    sources = sorted(Path(__file__).parent.glob("*.py"))
    return sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:8]


_DIGEST = _digest_of_kernels()


def compiled(signature: str) -> Callable[[Function], Function]:
    """Compile for these types when the module is loaded, not when the robot already walks.

    What is kept on disk is known by the function's name and the age of its file, but not of the files of what
    it calls. So the name is given a digest of them all.
    """

    def compile_or_load(function: Function) -> Function:
        function.__qualname__ += f"_{_DIGEST}"
        return cast("Function", njit(signature, cache=True, error_model="numpy")(function))

    return compile_or_load


inlined = cast("Callable[[Function], Function]", njit(inline="always", error_model="numpy"))
"""Decorator of what is compiled into the functions that call it."""
