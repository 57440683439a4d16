"""Dense work too small for a BLAS to pay, written as LLVM code for the processor at hand: all that other modules call.

Tiles of fronts are in `simd_tiles`, substitution in `simd_columns`, sums over elements in `simd_lanes`, what they share in `simd_code`.
"""

from __future__ import annotations

from femsense.fem.linalg.simd_code import fetch_ahead
from femsense.fem.linalg.simd_columns import (
    SIDES,
    down_one,
    down_six,
    down_six_sides,
    down_three,
    down_three_sides,
    up_one,
    up_six,
    up_six_sides,
    up_three,
    up_three_sides,
)
from femsense.fem.linalg.simd_lanes import LANES, add_divergence, add_gradient
from femsense.fem.linalg.simd_tiles import PADDING, WIDE, add_run, subtract_and_solve, subtract_product, write_product

__all__ = [
    "LANES",
    "PADDING",
    "SIDES",
    "WIDE",
    "add_divergence",
    "add_gradient",
    "add_run",
    "down_one",
    "down_six",
    "down_six_sides",
    "down_three",
    "down_three_sides",
    "fetch_ahead",
    "subtract_and_solve",
    "subtract_product",
    "up_one",
    "up_six",
    "up_six_sides",
    "up_three",
    "up_three_sides",
    "write_product",
]
