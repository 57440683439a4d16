"""Kernels that were compiled once are loaded without what numba compiles with."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

MODULE = """
import sys
from femsense.core.kernels import njit

@njit(cache=True)
def twice(x):
    return 2 * x

if __name__ == "__main__":
    print(twice(int(sys.argv[1])), twice.stats.cache_hits, "numba.np.arrayobj" in sys.modules)
    print(twice(0.25))
"""


def said(module: Path, number: int) -> list[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(module.parent), "PYTHONPATH": os.pathsep.join(sys.path)}
    call = [sys.executable, str(module), str(number)]
    return subprocess.run(call, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()


def test_a_kept_kernel_needs_no_rules_of_compiling_and_a_new_kind_of_argument_compiles(tmp_path: Path) -> None:
    module = tmp_path / "doubling.py"
    module.write_text(MODULE.replace("    print(twice(0.25))\n", ""), encoding="utf-8")
    first, then = said(module, 3), said(module, 4)
    assert [first, then] == [["6 Counter() True"], ["8 Counter({(int64,): 1}) False"]]
    module.write_text(MODULE, encoding="utf-8")
    assert [said(module, 5), said(module, 6)] == [["10 Counter() True", "0.5"], ["12 Counter({(int64,): 1}) False", "0.5"]]
