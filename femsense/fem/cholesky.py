# mypy: allow-untyped-decorators
"""Sparse Cholesky of stiffness matrices: multifrontal, supernodal, in single or double precision.

The analysis (elimination tree, supernodes, where every entry goes) depends on the sparsity pattern alone and is kept. Dense
work goes to the BLAS that SciPy brings. Right-hand sides with few entries, as points and cables have, only visit the part of
the tree above them: that is what makes `gram` (B'K⁻¹B without K⁻¹B) cheap. References: Liu 1992 (multifrontal method),
Ashcraft & Grimes 1989 (relaxed supernodes), Gilbert 1994 (the reach of a sparse right-hand side).
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from llvmlite import ir
from numba import njit, types
from numba.extending import get_cython_function_address, intrinsic
from scipy.sparse.linalg import splu

from femsense.arrays import BoolArray, FloatArray, IntArray
from femsense.fem.tiles import (
    PADDING,
    SIDES,
    WIDE,
    add_run,
    down_one,
    down_six,
    down_six_sides,
    down_three,
    down_three_sides,
    subtract_and_solve,
    subtract_product,
    up_one,
    up_six,
    up_six_sides,
    up_three,
    up_three_sides,
    write_product,
)
from femsense.parallel import one_blas_thread

FEW = 4
"""Right-hand sides that are solved one by one where the matrix has no blocks; more go through BLAS together."""
BESIDE = 40
"""Right-hand sides that are solved beside each other in groups of SIDES; BLAS takes less time for more. For 10 to 16 of a bar it took twice as long in a trial."""
LARGE = 144
"""Columns of a front from which on BLAS does as well as tiles in registers, and that tiles factorise at a time: two solid bars were slower
by up to 2 % with 120, and with 180 by up to 5 % in double precision (in single 1–2 % faster)."""


@intrinsic
def _call(typing_context: Any, address: Any, arguments: Any) -> Any:
    """Call a Fortran routine at an address; all its arguments are pointers, given as a tuple of integers."""
    del typing_context

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        integer = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [integer] * len(arguments))
        pointers = [builder.extract_value(values[1], i) for i in range(len(arguments))]
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(address, arguments), build


# --- analysis ------------------------------------------------------------------------------------------------------------


@njit(cache=True)
def _elimination_tree(indptr: IntArray, indices: IntArray) -> IntArray:
    n = len(indptr) - 1
    parent, ancestor = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    for j in range(n):
        for p in range(indptr[j], indptr[j + 1]):
            i = indices[p]
            while i != -1 and i < j:
                above = ancestor[i]
                ancestor[i] = j
                if above == -1:
                    parent[i] = j
                i = above
    return parent


@njit(cache=True)
def _postorder(parent: IntArray, weight: IntArray) -> IntArray:
    """Return the nodes of a forest, children before parents, the heaviest child last."""
    n = len(parent)
    head, follow = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    for j in np.argsort(weight):  # lists are filled from the front: the heaviest comes first in a list, last in the order
        if parent[j] != -1:
            follow[j] = head[parent[j]]
            head[parent[j]] = j
    order, stack, count = np.empty(n, np.int64), np.empty(n, np.int64), n
    for root in range(n - 1, -1, -1):
        if parent[root] != -1:
            continue
        top = 0
        stack[0] = root
        while top >= 0:
            j = stack[top]
            top -= 1
            count -= 1
            order[count] = j
            light = np.int64(head[j])
            first = top + 1
            while light != -1:
                top += 1
                stack[top] = light
                light = follow[light]
            stack[first : top + 1] = stack[first : top + 1][::-1].copy()
    return order


@njit(cache=True)
def _structures(indptr: IntArray, indices: IntArray, parent: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows below the diagonal of each column of the factor, as indptr and indices (sorted)."""
    n = len(parent)
    start = np.zeros(n + 1, np.int64)
    rows = np.empty(8 * len(indices) + 64, np.int64)
    mark = np.full(n, -1, np.int64)
    head, follow = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    end = 0
    for j in range(n):
        if end + n - j > len(rows):
            more = np.empty(2 * len(rows) + n, np.int64)
            more[:end] = rows[:end]
            rows = more
        first = end
        mark[j] = j
        for p in range(indptr[j], indptr[j + 1]):
            i = indices[p]
            if i > j and mark[i] != j:
                mark[i] = j
                rows[end] = i
                end += 1
        child = np.int64(head[j])
        while child != -1:
            for p in range(start[child], start[child + 1]):
                i = rows[p]
                if mark[i] != j:
                    mark[i] = j
                    rows[end] = i
                    end += 1
            child = follow[child]
        rows[first:end].sort()
        start[j + 1] = end
        if parent[j] != -1:
            follow[j] = head[parent[j]]
            head[parent[j]] = j
    return start, rows[:end].copy()


@njit(cache=True)
def _supernodes(count: IntArray, parent: IntArray, unit: int) -> IntArray:
    """Return the first column of each supernode and the end; small ones are merged with their parents where few zeros result."""
    n = len(parent)
    firsts = np.empty(n + 1, np.int64)
    zeros = np.zeros(n + 1, np.float64)
    k = 0
    for j in range(n):
        if k > 0 and parent[j - 1] == j and count[j - 1] == count[j] + 1:
            continue
        firsts[k] = j
        k += 1
    firsts[k] = n
    # merge from the left: a stack of supernodes, the top is tried with what follows
    kept = np.empty(n + 1, np.int64)
    top = 0
    for s in range(k):
        first, last = firsts[s], firsts[s + 1] - 1
        empty = 0.0
        while top > 0:
            below = kept[top - 1]
            if parent[first - 1] == -1 or parent[first - 1] > last:
                break
            wide, own = first - below, last + 1 - first
            height = own + count[last]
            fill = 0.0
            for c in range(below, first):
                fill += (first - c) + height - (count[c] + 1)
            total = 0.5 * (wide + own) * (wide + own + 1) + (wide + own) * count[last]
            share = (fill + empty) / total
            columns = unit * (wide + own)
            if not (columns <= 12 or (columns <= 36 and share < 0.2) or (columns <= 96 and share < 0.08) or share < 0.02):
                break
            empty = fill + empty
            first = below
            top -= 1
        kept[top] = first
        zeros[top] = empty
        top += 1
    kept[top] = n
    return kept[: top + 1].copy()


@njit(cache=True)
def _relations(firsts: IntArray, start: IntArray, rows: IntArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return parent of each supernode, its rows (indptr, indices), and where these stand in the front of the parent."""
    count = len(firsts) - 1
    n = firsts[count]
    owner = np.empty(n, np.int64)
    for s in range(count):
        owner[firsts[s] : firsts[s + 1]] = s
    begin = np.zeros(count + 1, np.int64)
    for s in range(count):
        last = firsts[s + 1] - 1
        begin[s + 1] = begin[s] + start[last + 1] - start[last]
    below = np.empty(begin[count], np.int64)
    place = np.empty(begin[count], np.int64)
    parent = np.full(count, -1, np.int64)
    for s in range(count):
        last = firsts[s + 1] - 1
        below[begin[s] : begin[s + 1]] = rows[start[last] : start[last + 1]]
        if begin[s + 1] > begin[s]:
            parent[s] = owner[below[begin[s]]]
    where = np.empty(n, np.int64)
    for s in range(count):
        p = parent[s]
        if p == -1:
            continue
        own = firsts[p + 1] - firsts[p]
        for q in range(begin[p], begin[p + 1]):
            where[below[q]] = own + q - begin[p]
        for q in range(begin[s], begin[s + 1]):
            i = below[q]
            place[q] = i - firsts[p] if i < firsts[p + 1] else where[i]
    return parent, begin, below, place


@njit(cache=True)
def _targets(
    indptr: IntArray, indices: IntArray, order: IntArray, inverse: IntArray, firsts: IntArray, begin: IntArray, below: IntArray,
    unit: int,
) -> tuple[IntArray, npt.NDArray[np.int32], npt.NDArray[np.int32]]:  # fmt: skip
    """Return where the entries of a matrix (in its scalar CSC) go: their begin for each supernode, source, place in its panel."""
    source = np.empty(len(indices), np.int32)
    target = np.empty(len(indices), np.int32)
    where = np.empty(len(order), np.int64)
    entries = np.zeros(len(firsts), np.int64)
    k = 0
    for s in range(len(firsts) - 1):
        own = firsts[s + 1] - firsts[s]
        height = unit * (own + begin[s + 1] - begin[s])
        for q in range(begin[s], begin[s + 1]):
            where[below[q]] = own + q - begin[s]
        for j in range(firsts[s], firsts[s + 1]):
            for b in range(unit):
                column = unit * order[j] + b
                at = (unit * (j - firsts[s]) + b) * height
                for p in range(indptr[column], indptr[column + 1]):
                    node, a = divmod(indices[p], unit)
                    i = inverse[node]
                    if i < j or (i == j and a < b):
                        continue
                    line = i - firsts[s] if i < firsts[s + 1] else where[i]
                    source[k] = p
                    target[k] = at + unit * line + a
                    k += 1
        entries[s + 1] = k
    return entries, source[:k].copy(), target[:k].copy()


@njit(cache=True)
def _runs(begin: IntArray, place: IntArray) -> tuple[IntArray, IntArray]:
    """Return the begin of each supernode's runs of rows that follow each other in the parent's front too, and where each run begins."""
    heads = np.zeros(len(begin), np.int64)
    runs = np.empty(len(place), np.int64)
    k = 0
    for s in range(len(begin) - 1):
        for q in range(begin[s], begin[s + 1]):
            if q == begin[s] or place[q] != place[q - 1] + 1:
                runs[k] = q - begin[s]
                k += 1
        heads[s + 1] = k
    return heads, runs[:k].copy()


@njit(cache=True)
def _rooms(parent: IntArray, begin: IntArray, unit: int) -> tuple[IntArray, int]:
    """Return where the update matrix of each supernode lives until its parent has taken it, and how much room all of them need.

    Each takes the first gap that is large enough.
    """
    count = len(parent)
    room, alive, kept, most = np.zeros(count, np.int64), np.empty(count, np.int64), 0, 0
    for s in range(count):
        size = (unit * (begin[s + 1] - begin[s])) ** 2
        at, end = 0, 0
        while at < kept:
            other = alive[at]
            if room[other] - end >= size:
                break
            end = room[other] + (unit * (begin[other + 1] - begin[other])) ** 2
            at += 1
        room[s] = end
        most = max(most, end + size)
        alive[at + 1 : kept + 1] = alive[at:kept].copy()
        alive[at] = s
        kept += 1
        left = 0
        for k in range(kept):
            if parent[alive[k]] != s and (alive[k] != s or size > 0):
                alive[left] = alive[k]
                left += 1
        kept = left
    return room, most


WORTH_PEELING = 10_000
"""Free nodes from which on minimum degree is not asked where there is METIS: telling it takes SuperLU a second, and minutes on huge
meshes. With 19 000 to 58 000 nodes cutting made half the work on a solid bar and on thin limbs alike (`body.py orders` has the latter)."""
WORTH_CUTTING = 500
"""Nodes; below, either order takes a millisecond."""


def fill_reducing_order(rows: IntArray, columns: IntArray, free: BoolArray) -> IntArray:
    """Return the free nodes in an order of little fill for the couplings rows–columns: of multiple minimum degree (by SuperLU) and
    nested dissection (by METIS, where it is installed) the one that makes less work. Thick bodies are better cut than peeled."""
    n = len(free)
    upper = sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    nodes = np.flatnonzero(free)
    graph = sp.csr_matrix((upper + upper.T)[nodes][:, nodes])
    orders = _nested_dissection(graph)
    if len(nodes) < WORTH_PEELING or not orders:
        orders.insert(0, minimum_degree(graph))
    best = min(orders, key=lambda order: elimination_work(graph, order)) if len(orders) > 1 else orders[0]
    return np.asarray(nodes[best])


def minimum_degree(graph: sp.csr_matrix) -> IntArray:
    """Return the nodes of a symmetric graph by multiple minimum degree, shape (n,)."""
    dominant = (graph + sp.diags_array(np.asarray(graph.sum(axis=1)).ravel() + 1.0)).tocsc()
    lu = splu(dominant, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(np.argsort(lu.perm_c))


def _nested_dissection(graph: sp.csr_matrix) -> list[IntArray]:
    """Return the order of METIS; none where there is little to cut (and where nodes stand alone, which METIS does not survive)."""
    between = sp.csr_matrix(graph - sp.diags_array(graph.diagonal()))
    between.eliminate_zeros()
    if graph.shape[0] < WORTH_CUTTING or (np.diff(between.indptr) == 0).any():
        return []
    try:
        import pymetis
    except ImportError:
        return []
    neighbours = pymetis.CSRAdjacency(between.indptr, between.indices)
    return [np.asarray(pymetis.nested_dissection(adjacency=neighbours)[0], np.int64)]


def elimination_work(graph: sp.csr_matrix, order: IntArray) -> float:
    """Return the multiplications of a factor of some nodes of a symmetric graph in an order: Σ (entries of a column)²."""
    part = graph[order][:, order].tocsc()
    part.sort_indices()
    indptr, indices = part.indptr.astype(np.int64), part.indices.astype(np.int64)
    start, _ = _structures(indptr, indices, _elimination_tree(indptr, indices))
    return float((np.diff(start + np.arange(len(start))).astype(np.float64) ** 2).sum())


@dataclass(frozen=True, eq=False, slots=True)
class Analysis:
    """What the factorisation of every matrix of one pattern shares. Nodes are `unit` unknowns each."""

    unit: int
    order: IntArray
    """Unknowns in the order of elimination, shape (f,)."""
    firsts: IntArray
    """First node of each supernode, and the end, shape (s + 1,)."""
    parent: IntArray
    """Supernode above, −1 at a root, shape (s,)."""
    begin: IntArray
    """Where the nodes below each supernode begin in `below`, shape (s + 1,)."""
    below: IntArray
    place: IntArray
    """Where each of `below` stands in the front of the parent."""
    offset: IntArray
    """Where the panel of each supernode begins in the factor, shape (s + 1,)."""
    entries: IntArray
    """Where the entries of the matrix that go into each panel begin in `source` and `target`, shape (s + 1,)."""
    source: npt.NDArray[np.int32]
    target: npt.NDArray[np.int32]
    """Their places in the matrix and in the panel."""
    heads: IntArray
    """Where the runs of each supernode begin in `runs`, shape (s + 1,)."""
    runs: IntArray
    """First row of each run of rows below that follow each other in the front of the parent as well."""
    room: IntArray
    """Where the update matrix of each supernode lives, shape (s,)."""
    stack: int
    """Entries of the room of all update matrices."""
    rank: IntArray
    """Place of each unknown in the order of elimination, shape (f,)."""
    owner: IntArray
    """Supernode of each unknown in the order of elimination, shape (f,)."""
    idle: dict[tuple[str, int], list[npt.NDArray[Any]]]
    """Memory of what is gone, by kind and number of entries, taken again by what is new: pages that are fresh from the system take longer than a factor."""
    columns: dict[tuple[str, int], npt.NDArray[Any]]
    """Zeros for the columns of `Cholesky.gram`, by kind and number: it leaves them as it finds them."""

    @property
    def size(self) -> int:
        return len(self.order)

    @property
    def tallest(self) -> int:
        """Rows of the tallest front."""
        return int(self.unit * (np.diff(self.firsts) + np.diff(self.begin)).max(initial=0))

    def take(self, kind: str, entries: int) -> npt.NDArray[Any]:
        """Return memory for so many numbers and what may be read beyond them."""
        size = entries + PADDING
        try:
            return self.idle.setdefault((kind, size), []).pop()
        except IndexError:
            return np.empty(size, kind)

    def give_back(self, memory: npt.NDArray[Any]) -> None:
        """Let others take memory that is needed no more."""
        self.idle[memory.dtype.char, len(memory)].append(memory)


def analyse(indptr: IntArray, indices: IntArray) -> Analysis:
    """Analyse the pattern of a symmetric matrix in CSC with sorted indices; its order is taken as one of little fill."""
    unit = 3 if _has_blocks(indptr, indices) else 1
    heads, entries = np.asarray(indptr, np.int64), np.asarray(indices, np.int64)
    counts = np.diff(heads)[::unit] // unit
    rows = np.concatenate([[0], np.cumsum(counts)])
    columns = entries[_ranges(heads[:-1:unit], counts, unit)] // unit
    parent = _elimination_tree(rows, columns)
    order = _postorder(parent, np.diff(_structures(rows, columns, parent)[0]))
    inverse = np.empty_like(order)
    inverse[order] = np.arange(len(order))
    columns = inverse[columns[_ranges(rows[:-1][order], counts[order], 1)]]
    rows = np.concatenate([[0], np.cumsum(counts[order])])
    parent = np.where(parent[order] >= 0, inverse[parent[order]], -1)
    start, structure = _structures(rows, columns, parent)
    firsts = _supernodes(np.diff(start), parent, unit)
    above, begin, below, place = _relations(firsts, start, structure)
    width = unit * np.diff(firsts)
    offset = np.concatenate([[0], np.cumsum(width * (width + unit * np.diff(begin)))])
    starts, source, target = _targets(heads, entries, order, inverse, firsts, begin, below, unit)
    room, stack = _rooms(above, begin, unit)
    run_heads, runs = _runs(begin, place)
    unknowns = (unit * order[:, None] + np.arange(unit)).ravel()
    rank = np.empty_like(unknowns)
    rank[unknowns] = np.arange(len(unknowns))
    owner = np.repeat(np.arange(len(above)), width)
    return Analysis(
        unit=unit, order=unknowns, firsts=firsts, parent=above, begin=begin, below=below, place=place, offset=offset, entries=starts,
        source=source, target=target, heads=run_heads, runs=runs, room=room, stack=int(stack), rank=rank, owner=owner, idle={}, columns={},
    )  # fmt: skip


def _ranges(starts: IntArray, counts: IntArray, step: int) -> IntArray:
    """Return starts[0], starts[0] + step, … counts[0] times, then the same of starts[1], and so on."""
    ends = np.cumsum(counts)
    inner = np.arange(int(counts.sum()), dtype=np.int64) - np.repeat(ends - counts, counts)
    return np.asarray(np.repeat(starts, counts) + step * inner)


def _has_blocks(indptr: IntArray, indices: IntArray) -> bool:
    """Return whether a pattern consists of full 3 × 3 blocks."""
    if (len(indptr) - 1) % 3 or len(indices) % 9:
        return False
    counts = np.diff(indptr).reshape(-1, 3)
    if (counts != counts[:, :1]).any() or (counts % 3).any():
        return False
    triples = np.asarray(indices).reshape(-1, 3)
    return bool((triples[:, 0] % 3 == 0).all() and (np.diff(triples, axis=1) == 1).all())


# --- numbers -------------------------------------------------------------------------------------------------------------


@njit(cache=True)
def _factor_corner(L: FloatArray, at: int, height: int, columns: int, corner: FloatArray) -> bool:
    """Factorise the first columns ≤ 6 and rows of a panel that begins at `at`; write them to `corner` too, with reciprocal diagonal."""
    for j in range(columns):
        pivot = L[at + j * height + j]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / np.sqrt(pivot)
        corner[j * WIDE + j] = inverse
        L[at + j * height + j] = pivot * inverse
        for i in range(j + 1, columns):
            value = L[at + j * height + i] * inverse
            L[at + j * height + i] = value
            corner[i * WIDE + j] = value
        for k in range(j + 1, columns):
            scale = corner[k * WIDE + j]
            for i in range(k, columns):
                L[at + k * height + i] -= scale * corner[i * WIDE + j]
    return True


@njit(cache=True)
def _factor_panel(L: FloatArray, start: int, height: int, first: int, last: int, corner: FloatArray) -> bool:
    """Factorise columns first … last of a panel, those before being done with; False where a pivot is not positive."""
    width = L.itemsize
    for j in range(first, last, WIDE):
        columns, depth = min(WIDE, last - j), j - first
        at = start + j * height + j
        left, here = L.ctypes.data + width * (start + first * height + j), L.ctypes.data + width * at
        subtract_product(L, left, left, height, here, height, columns, columns, depth)
        if not _factor_corner(L, at, height, columns, corner):
            return False
        step, rows = width * columns, height - j - columns
        subtract_and_solve(L, left + step, left, height, here + step, height, rows, columns, depth, corner.ctypes.data)
    return True


@njit(cache=True)
def _take_children(
    low: int, high: int, front: int, height: int, child: int, follow: IntArray, unit: int, begin: IntArray, place: IntArray,
    heads: IntArray, runs: IntArray, room: IntArray, pile: int, L: FloatArray,
) -> None:  # fmt: skip
    """Add the update matrices of a child and its followers to nodes low … high of columns of a front at an address.

    It goes from one pair of runs to the next: columns with the same few rows follow each other, which the processor foresees.
    """
    node, step = L.itemsize * unit, L.itemsize * height
    while child != -1:
        rows, end = place[begin[child] : begin[child + 1]], heads[child + 1]
        update, size = pile + L.itemsize * room[child], node * len(rows)
        for c in range(heads[child], end):
            last = runs[c + 1] if c + 1 < end else len(rows)
            shift = rows[runs[c]] - runs[c]
            left, right = max(runs[c], low - shift), min(last, high - shift)
            for j in range(left, right):
                to, line = front + (unit * step + node) * (j + shift), update + (unit * size + node) * j
                for b in range(unit):
                    add_run(L, to + step * b, line + size * b, unit * (last - j))
            for r in range(c + 1, end if left < right else c):
                i, after = runs[r], runs[r + 1] if r + 1 < end else len(rows)
                to, line = front + unit * step * (left + shift) + node * rows[i], update + unit * size * left + node * i
                for b in range(unit * (right - left)):
                    add_run(L, to + step * b, line + size * b, unit * (after - i))
        child = follow[child]


@njit(cache=True, nogil=True)
def _factorise(
    values: FloatArray, entries: IntArray, source: IntArray, target: IntArray, unit: int, firsts: IntArray, parent: IntArray,
    begin: IntArray, place: IntArray, offset: IntArray, heads: IntArray, runs: IntArray, room: IntArray, blas: IntArray, L: FloatArray,
    stack: FloatArray, head: IntArray, follow: IntArray, letters: npt.NDArray[np.uint8], numbers: npt.NDArray[np.int32], scalars: FloatArray,
) -> bool:  # fmt: skip
    """Write the factor; False where the matrix is not positive definite."""
    width, corner = L.itemsize, np.empty(WIDE * WIDE, L.dtype)
    lower, no, yes = letters.ctypes.data, letters.ctypes.data + 1, letters.ctypes.data + 2
    at, minus, one, zero = numbers.ctypes.data, scalars.ctypes.data, scalars.ctypes.data + width, scalars.ctypes.data + 2 * width
    base, pile = L.ctypes.data, stack.ctypes.data
    family = (follow, unit, begin, place, heads, runs, room, pile, L)
    head[:] = -1
    for s in range(len(parent)):
        own = firsts[s + 1] - firsts[s]
        columns, rest = unit * own, unit * (begin[s + 1] - begin[s])
        height, start, update = columns + rest, offset[s], pile + width * room[s]
        L[start : offset[s + 1]] = 0.0
        for k in range(entries[s], entries[s + 1]):
            L[start + target[k]] = values[source[k]]
        _take_children(0, own, base + width * start, height, head[s], *family)
        for j in range(0, columns, LARGE):
            last = min(j + LARGE, columns)
            if not _factor_panel(L, start, height, j, last, corner):
                return False
            if last < columns:  # the rest of the panel: A[last:, last:columns] −= X[last:, j:last] X[last:columns, j:last]ᵀ
                numbers[0], numbers[1], numbers[2], numbers[3] = height - last, columns - last, last - j, height
                x, y = base + width * (start + j * height + last), base + width * (start + last * height + last)
                _call(blas[0], (no, yes, at, at + 4, at + 8, minus, x, at + 12, x, at + 12, one, y, at + 12))
        x = base + width * (start + columns)
        if columns > LARGE and rest > 0:
            numbers[0], numbers[1], numbers[2], numbers[3] = rest, columns, height, rest
            _call(blas[1], (lower, no, at, at + 4, minus, x, at + 8, zero, update, at + 12))
        else:
            for j in range(0, rest, WIDE):
                here = x + width * j
                to = update + width * (j * rest + j)
                write_product(L, here, here, height, to, rest, rest - j, min(WIDE, rest - j), columns)
        _take_children(own, height, update - width * columns * (rest + 1), rest, head[s], *family)
        if parent[s] != -1:
            follow[s] = head[parent[s]]
            head[parent[s]] = s
    return True


@njit(cache=True, nogil=True)
def _solve_one(
    unit: int,
    firsts: IntArray,
    begin: IntArray,
    below: IntArray,
    offset: IntArray,
    L: FloatArray,
    x: FloatArray,
    half: FloatArray,
) -> None:
    """Solve in place for one right-hand side in the order of elimination."""
    width, base, y = L.itemsize, L.ctypes.data, half.ctypes.data
    for s in range(len(firsts) - 1):
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        height = columns + unit * (begin[s + 1] - begin[s])
        for i in range(columns):
            half[i] = x[c0 + i]
        for i in range(columns, height):
            half[i] = 0.0
        j = 0
        while j < columns:
            size = 6 if columns - j >= 6 else 3 if columns - j >= 3 else 1
            at, to = base + width * (offset[s] + j * height + j), y + width * j
            left, ahead = height - j - size, width * size * (height + 1)
            if size == 6:
                down_six(L, at, height, to, left, ahead)
            elif size == 3:
                down_three(L, at, height, to, left, ahead)
            else:
                down_one(L, at, height, to, left, ahead)
            j += size
        for i in range(columns):
            x[c0 + i] = half[i]
        for q in range(begin[s + 1] - begin[s]):
            line = unit * below[begin[s] + q]
            for a in range(unit):
                x[line + a] += half[columns + unit * q + a]
    for s in range(len(firsts) - 2, -1, -1):
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        height = columns + unit * (begin[s + 1] - begin[s])
        for i in range(columns):
            half[i] = x[c0 + i]
        for q in range(begin[s + 1] - begin[s]):
            line = unit * below[begin[s] + q]
            for a in range(unit):
                half[columns + unit * q + a] = x[line + a]
        j = columns
        while j > 0:
            size = 6 if j >= 6 else 3 if j >= 3 else 1
            j -= size
            at, to = base + width * (offset[s] + j * height + j), y + width * j
            left, ahead = height - j - size, -width * size * (height + 1)
            if size == 6:
                up_six(L, at, height, to, left, ahead)
            elif size == 3:
                up_three(L, at, height, to, left, ahead)
            else:
                up_one(L, at, height, to, left, ahead)
        for i in range(columns):
            x[c0 + i] = half[i]


@njit(cache=True, nogil=True)
def _solve_sides(
    unit: int,
    firsts: IntArray,
    begin: IntArray,
    below: IntArray,
    offset: IntArray,
    L: FloatArray,
    x: FloatArray,
    half: FloatArray,
) -> None:
    """Solve in place for groups of SIDES right-hand sides, x (g, f · SIDES), in the order of elimination; unit is 3 here. half (g, …) has room for the
    tallest front. What is read of the factor for one group is in the cache for the others."""
    width, base, groups = L.itemsize, L.ctypes.data, len(x)
    line, block = width * SIDES, SIDES * unit
    for s in range(len(firsts) - 1):
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        height = columns + unit * (begin[s + 1] - begin[s])
        half[:, : SIDES * columns] = x[:, SIDES * c0 : SIDES * (c0 + columns)]
        half[:, SIDES * columns : SIDES * height] = 0.0
        j = 0
        while j < columns:
            size = 6 if columns - j >= 6 else 3
            at, left, ahead = base + width * (offset[s] + j * height + j), height - j - size, width * size * (height + 1)
            for g in range(groups):
                if size == 6:
                    down_six_sides(L, at, height, half[g].ctypes.data + line * j, left, ahead)
                else:
                    down_three_sides(L, at, height, half[g].ctypes.data + line * j, left, ahead)
            j += size
        x[:, SIDES * c0 : SIDES * (c0 + columns)] = half[:, : SIDES * columns]
        for g in range(groups):
            to, y = x[g].ctypes.data, half[g].ctypes.data
            for q in range(begin[s + 1] - begin[s]):
                add_run(L, to + width * block * below[begin[s] + q], y + line * (columns + unit * q), block)
    for s in range(len(firsts) - 2, -1, -1):
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        height = columns + unit * (begin[s + 1] - begin[s])
        half[:, : SIDES * columns] = x[:, SIDES * c0 : SIDES * (c0 + columns)]
        for q in range(begin[s + 1] - begin[s]):
            source, to = block * below[begin[s] + q], SIDES * (columns + unit * q)
            half[:, to : to + block] = x[:, source : source + block]
        j = columns
        while j > 0:
            size = 6 if j >= 6 else 3
            j -= size
            at, left, ahead = base + width * (offset[s] + j * height + j), height - j - size, -width * size * (height + 1)
            for g in range(groups):
                if size == 6:
                    up_six_sides(L, at, height, half[g].ctypes.data + line * j, left, ahead)
                else:
                    up_three_sides(L, at, height, half[g].ctypes.data + line * j, left, ahead)
        x[:, SIDES * c0 : SIDES * (c0 + columns)] = half[:, : SIDES * columns]


@njit(cache=True, nogil=True)
def _solve_many(
    unit: int, firsts: IntArray, begin: IntArray, below: IntArray, offset: IntArray, blas: IntArray, L: FloatArray, X: FloatArray,
    work: FloatArray, letters: npt.NDArray[np.uint8], numbers: npt.NDArray[np.int32], scalars: FloatArray,
) -> None:  # fmt: skip
    """Solve in place for the columns of X (f, k) in the order of elimination; work holds k times the tallest front."""
    width, k = L.itemsize, X.shape[1]
    lower, no, yes, right = letters.ctypes.data, letters.ctypes.data + 1, letters.ctypes.data + 2, letters.ctypes.data + 3
    at = numbers.ctypes.data
    minus, one, zero = scalars.ctypes.data, scalars.ctypes.data + width, scalars.ctypes.data + 2 * width
    numbers[0] = k
    for s in range(len(firsts) - 1):
        c0, columns, rows = unit * firsts[s], unit * (firsts[s + 1] - firsts[s]), begin[s + 1] - begin[s]
        numbers[1], numbers[2], numbers[3] = columns, unit * rows, columns + unit * rows
        panel, here = L.ctypes.data + width * offset[s], X.ctypes.data + width * c0 * k
        _call(blas[2], (right, lower, yes, no, at, at + 4, one, panel, at + 12, here, at))
        if rows > 0:
            _call(
                blas[0],
                (no, yes, at, at + 8, at + 4, one, here, at, panel + width * columns, at + 12, zero, work.ctypes.data, at),
            )
        for q in range(rows):
            for a in range(unit):
                line, part = X[unit * below[begin[s] + q] + a], work[(unit * q + a) * k : (unit * q + a + 1) * k]
                for r in range(k):
                    line[r] -= part[r]
    for s in range(len(firsts) - 2, -1, -1):
        c0, columns, rows = unit * firsts[s], unit * (firsts[s + 1] - firsts[s]), begin[s + 1] - begin[s]
        numbers[1], numbers[2], numbers[3] = columns, unit * rows, columns + unit * rows
        panel, here = L.ctypes.data + width * offset[s], X.ctypes.data + width * c0 * k
        for q in range(rows):
            for a in range(unit):
                work[(unit * q + a) * k : (unit * q + a + 1) * k] = X[unit * below[begin[s] + q] + a]
        if rows > 0:
            _call(
                blas[0],
                (no, no, at, at + 4, at + 8, minus, work.ctypes.data, at, panel + width * columns, at + 12, one, here, at),
            )
        _call(blas[2], (right, lower, no, no, at, at + 4, one, panel, at + 12, here, at))


@njit(cache=True)
def _reach(parent: IntArray, owner: IntArray, indptr: IntArray, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return which right-hand sides (columns of B, rows in the order of elimination) each supernode sees: indptr, columns."""
    count, columns = len(parent), len(indptr) - 1
    mark = np.full(count, -1, np.int64)
    size = np.zeros(count + 1, np.int64)
    for fill in range(2):
        mark[:] = -1
        if fill == 1:
            start = np.zeros(count + 1, np.int64)
            start[1:] = np.cumsum(size[:count])
            active = np.empty(start[count], np.int64)
            size[:] = 0
        for r in range(columns):
            for p in range(indptr[r], indptr[r + 1]):
                s = owner[rows[p]]
                while s != -1 and mark[s] != r:
                    mark[s] = r
                    if fill == 1:
                        active[start[s] + size[s]] = r
                    size[s] += 1
                    s = parent[s]
    return start, active


@njit(cache=True)
def _gram(
    unit: int, firsts: IntArray, begin: IntArray, below: IntArray, offset: IntArray, start: IntArray, active: IntArray, blas: IntArray,
    L: FloatArray, X: FloatArray, work: FloatArray, W: FloatArray,
    letters: npt.NDArray[np.uint8], numbers: npt.NDArray[np.int32], scalars: FloatArray,
) -> None:  # fmt: skip
    """Add XᵀK⁻¹X to W (lower half in the order of `active`); X (f, k), in the order of elimination, is zero after it."""
    width = L.itemsize
    lower, no, yes, right = letters.ctypes.data, letters.ctypes.data + 1, letters.ctypes.data + 2, letters.ctypes.data + 3
    at = numbers.ctypes.data
    one, zero = scalars.ctypes.data + width, scalars.ctypes.data + 2 * width
    for s in range(len(firsts) - 1):
        seen = active[start[s] : start[s + 1]]
        k = len(seen)
        if k == 0:
            continue
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        rest = unit * (begin[s + 1] - begin[s])
        height = columns + rest
        for i in range(columns):
            for r in range(k):
                work[i * k + r] = X[c0 + i, seen[r]]
                X[c0 + i, seen[r]] = 0.0
        numbers[0], numbers[1], numbers[2], numbers[3] = k, columns, rest, height
        here = work.ctypes.data
        after = here + width * columns * k
        _call(blas[2], (right, lower, yes, no, at, at + 4, one, L.ctypes.data + width * offset[s], at + 12, here, at))
        if rest > 0:
            below_panel = L.ctypes.data + width * (offset[s] + columns)
            _call(blas[0], (no, yes, at, at + 8, at + 4, one, here, at, below_panel, at + 12, zero, after, at))
            for q in range(begin[s + 1] - begin[s]):
                to = unit * below[begin[s] + q]
                for a in range(unit):
                    line = (columns + unit * q + a) * k
                    for r in range(k):
                        X[to + a, seen[r]] -= work[line + r]
        _call(blas[1], (lower, no, at, at + 4, one, here, at, zero, after, at))
        for c in range(k):
            for r in range(c, k):
                W[seen[r], seen[c]] += work[(columns + c) * k + r]


class Cholesky:
    """A factor K = LLᵀ of a positive definite matrix."""

    def __init__(self, analysis: Analysis, L: npt.NDArray[Any]) -> None:
        self.negative = 0
        self.size = analysis.size
        self.bytes = int(analysis.offset[-1]) * L.itemsize
        self._analysis, self._L = analysis, L
        weakref.finalize(self, analysis.give_back, L)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k)."""
        a, kind = self._analysis, self._L.dtype
        right = np.asarray(right)
        columns = right.reshape(a.size, -1)
        count = columns.shape[1]
        if 1 < count <= BESIDE and a.unit == 3:
            groups = -(-count // SIDES)
            x, half = np.zeros((groups, a.size, SIDES), kind), np.empty((groups, SIDES * a.tallest), kind)
            for own, part in zip(x, np.split(columns, range(SIDES, count, SIDES), axis=1)):
                own[:, : part.shape[1]] = part[a.order]
            _solve_sides(a.unit, a.firsts, a.begin, a.below, a.offset, self._L, x.reshape(groups, -1), half)
            ordered = np.concatenate(list(x), axis=1)[:, :count]
        elif count < FEW:
            x = np.ascontiguousarray(columns[a.order].T, dtype=kind)
            work = np.empty(a.size, kind)
            for one in x:
                _solve_one(a.unit, a.firsts, a.begin, a.below, a.offset, self._L, one, work)
            ordered = x.T
        else:
            ordered = np.ascontiguousarray(columns[a.order], dtype=kind)
            work = np.empty(a.unit * int(np.diff(a.begin).max(initial=0)) * ordered.shape[1], kind)
            _solve_many(
                a.unit, a.firsts, a.begin, a.below, a.offset, _BLAS[kind.char], self._L, ordered, work, *_constants(kind.char)
            )
        return ordered[a.rank].astype(np.float64, copy=False).reshape(right.shape)

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        """Return BᵀK⁻¹B = (L⁻¹B)ᵀ(L⁻¹B), shape (k, k), for sparse columns B, shape (f, k)."""
        a, k, kind = self._analysis, columns.shape[1], self._L.dtype
        rows = a.rank[columns.indices]
        indptr = columns.indptr.astype(np.int64)
        start, active = _reach(a.parent, a.owner, indptr, rows)
        X = a.columns.pop((kind.char, k), None)
        X = np.zeros((a.size, k), kind) if X is None else X
        X[rows, np.repeat(np.arange(k), np.diff(indptr))] = columns.data
        W = np.zeros((k, k))
        tallest = int((np.diff(a.firsts) + np.maximum(np.diff(a.begin), k)).max(initial=0))
        work = np.empty(a.unit * tallest * k, kind)
        _gram(
            a.unit,
            a.firsts,
            a.begin,
            a.below,
            a.offset,
            start,
            active,
            _BLAS[kind.char],
            self._L,
            X,
            work,
            W,
            *_constants(kind.char),
        )
        a.columns[kind.char, k] = X
        return np.asarray(W + np.tril(W, -1).T)


def cholesky(
    analysis: Analysis, values: FloatArray, *, single: bool = False, source: npt.NDArray[np.int32] | None = None
) -> Cholesky | None:
    """Factorise a symmetric matrix of an analysed pattern; None where it is not positive definite.

    Arguments:
        analysis: from `analyse`.
        values: its entries in CSC order, shape (nnz,).
        single: work in single precision (errors of 1e-7 times the condition of the matrix: a preconditioner).
        source: where the entries that `Analysis.source` names are in `values`, where these are in another order.
    """
    a, kind = analysis, "f" if single else "d"
    L, stack = a.take(kind, int(a.offset[-1])), a.take(kind, a.stack)
    head, follow = np.empty(len(a.parent), np.int64), np.empty(len(a.parent), np.int64)
    with one_blas_thread():
        definite = _factorise(
            values, a.entries, a.source if source is None else source, a.target, a.unit, a.firsts, a.parent, a.begin, a.place, a.offset, a.heads, a.runs, a.room,
            _BLAS[kind], L, stack, head, follow, *_constants(kind),
        )  # fmt: skip
    a.give_back(stack)
    if definite:
        return Cholesky(a, L)
    a.give_back(L)
    return None


def _addresses(kind: str) -> IntArray:
    return np.array(
        [get_cython_function_address("scipy.linalg.cython_blas", kind + name) for name in ("gemm", "syrk", "trsm")],
        dtype=np.int64,
    )


def _constants(kind: str) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32], npt.NDArray[Any]]:
    """Return what BLAS is pointed at: letters L N T R, room for integers, and −1, 1, 0."""
    return np.frombuffer(b"LNTR", np.uint8), np.zeros(4, np.int32), np.array([-1.0, 1.0, 0.0], kind)


_BLAS = {"d": _addresses("d"), "f": _addresses("s")}
