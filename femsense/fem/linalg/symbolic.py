# mypy: allow-untyped-decorators
"""The symbolic factorisation, common to all matrices of one pattern."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import IntArray
from femsense.core.errors import InputError
from femsense.core.kernels import njit
from femsense.fem.linalg.ordering import _elimination_tree, _structures


class Tree(NamedTuple):
    """The supernodes of a factor and their tree: all that the compiled kernels read of an analysis.

    A node has three unknowns: a point in space. A supernode is a run of nodes with the same rows below the diagonal. Its columns
    stand as one dense panel in the factor: first its own nodes, then the nodes below. A front is the panel with the update matrix, the
    part that its elimination subtracts from the nodes below. Arrays of shape (s + 1,) hold the beginning of each supernode's list in another
    array, and the end of the last list.
    """

    firsts: IntArray
    """First node of each supernode, shape (s + 1,)."""
    parent: IntArray
    """Supernode above, −1 at a root, shape (s,)."""
    begin: IntArray
    """Where the nodes below each supernode begin in `below`, shape (s + 1,)."""
    below: IntArray
    """Nodes below the supernodes."""
    place: IntArray
    """Where each of `below` stands in the front of the parent."""
    offset: IntArray
    """Where the panel of each supernode begins in the factor, shape (s + 1,)."""
    entries: IntArray
    """Where the entries of the matrix that go into each panel begin in `source` and `target`, shape (s + 1,)."""
    source: npt.NDArray[np.int32]
    """Places of these entries in the matrix."""
    target: npt.NDArray[np.int32]
    """Places of these entries in the panel."""
    room: IntArray
    """Where the update matrix of each supernode stands in work memory until its parent has taken it, shape (s,)."""
    stack: int
    """Entries of the work memory of all update matrices."""


@njit(cache=True)
def _postorder(parent: IntArray, by_weight: IntArray) -> IntArray:
    """Return the nodes of a forest, children before parents, the heaviest child last; `by_weight` are its nodes,
    the lightest first."""
    n = len(parent)
    head, follow = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    for j in by_weight:  # lists are filled from the front: the heaviest comes first in a list, last in the order
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
            low, high = first, top
            while low < high:
                stack[low], stack[high] = stack[high], stack[low]
                low, high = low + 1, high - 1
    return order


@njit(cache=True)
def _supernodes(count: IntArray, parent: IntArray) -> IntArray:
    """Return the first column of each supernode and the end; a small supernode is merged with its parent if few zeros result."""
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
            columns = 3 * (wide + own)
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
        for q in range(begin[s + 1] - begin[s]):
            below[begin[s] + q] = rows[start[last] + q]
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
    indptr: IntArray,
    indices: IntArray,
    order: IntArray,
    inverse: IntArray,
    firsts: IntArray,
    begin: IntArray,
    below: IntArray,
) -> tuple[IntArray, npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Return where the entries of a matrix (in its scalar CSC) go: their begin for each supernode, source, place in its panel."""
    source = np.empty(len(indices), np.int32)
    target = np.empty(len(indices), np.int32)
    where = np.empty(len(order), np.int64)
    entries = np.zeros(len(firsts), np.int64)
    k = 0
    for s in range(len(firsts) - 1):
        own = firsts[s + 1] - firsts[s]
        height = 3 * (own + begin[s + 1] - begin[s])
        for q in range(begin[s], begin[s + 1]):
            where[below[q]] = own + q - begin[s]
        for j in range(firsts[s], firsts[s + 1]):
            for b in range(3):
                column = 3 * order[j] + b
                at = (3 * (j - firsts[s]) + b) * height
                for p in range(indptr[column], indptr[column + 1]):
                    node, a = divmod(indices[p], 3)
                    i = inverse[node]
                    if i < j or (i == j and a < b):
                        continue
                    line = i - firsts[s] if i < firsts[s + 1] else where[i]
                    source[k] = p
                    target[k] = at + 3 * line + a
                    k += 1
        entries[s + 1] = k
    return entries, source[:k].copy(), target[:k].copy()


@njit(cache=True)
def _rooms(parent: IntArray, begin: IntArray) -> tuple[IntArray, int]:
    """Return where the update matrix of each supernode lives until its parent has taken it, and how much room all of them need.

    Each takes the first gap that is large enough.
    """
    count = len(parent)
    room, alive, kept, most = np.zeros(count, np.int64), np.empty(count, np.int64), 0, 0
    for s in range(count):
        height = 3 * (begin[s + 1] - begin[s])
        size = height * height
        at, end = 0, 0
        while at < kept:
            other = alive[at]
            if room[other] - end >= size:
                break
            height = 3 * (begin[other + 1] - begin[other])
            end = room[other] + height * height
            at += 1
        room[s] = end
        most = max(most, end + size)
        for k in range(kept, at, -1):
            alive[k] = alive[k - 1]
        alive[at] = s
        kept += 1
        left = 0
        for k in range(kept):
            if parent[alive[k]] != s and (alive[k] != s or size > 0):
                alive[left] = alive[k]
                left += 1
        kept = left
    return room, most


@njit(cache=True)
def _layout(
    heads: IntArray,
    entries: IntArray,
    order: IntArray,
    inverse: IntArray,
    rows: IntArray,
    columns: IntArray,
    parent: IntArray,
) -> Tree:
    """Return the tree of supernodes of a pattern in an order of elimination: one kernel to load instead of six."""
    start, structure = _structures(rows, columns, parent)
    count = np.empty(len(parent), np.int64)
    for j in range(len(parent)):
        count[j] = start[j + 1] - start[j]
    firsts = _supernodes(count, parent)
    above, begin, below, place = _relations(firsts, start, structure)
    offset = np.zeros(len(firsts), np.int64)
    for s in range(len(above)):
        own = 3 * (firsts[s + 1] - firsts[s])
        offset[s + 1] = offset[s] + own * (own + 3 * (begin[s + 1] - begin[s]))
    starts, source, target = _targets(heads, entries, order, inverse, firsts, begin, below)
    room, stack = _rooms(above, begin)
    return Tree(firsts, above, begin, below, place, offset, starts, source, target, room, stack)


class Pool:
    """Memory that is used again: fresh pages of the system take longer than the factor that is written to them.

    An array of the pool is an ordinary array. Its memory returns to the pool by itself, as soon as nothing refers to the array any more;
    a view does not count, so whoever slices it keeps the array too. Threads may share a pool.
    """

    def __init__(self) -> None:
        self.idle: dict[tuple[str, int], list[npt.NDArray[Any]]] = {}
        """Memory that no array uses, by kind and number of entries."""

    def empty(self, kind: str, entries: int) -> npt.NDArray[Any]:
        """Return an array of any content, shape (entries,)."""
        idle = self.idle.setdefault((kind, entries), [])
        try:
            memory = idle.pop()
        except IndexError:
            memory = np.empty(entries, kind)
        array = memory[:]  # a second array on the same memory: when it is collected, the first one goes back
        weakref.finalize(array, idle.append, memory)
        return array


@dataclass(frozen=True, eq=False, slots=True)
class Analysis:
    """Data common to the factorisations of all matrices of one pattern, and the memory for their factors."""

    tree: Tree
    order: IntArray
    """Unknowns in the order of elimination, shape (f,)."""
    rank: IntArray
    """Place of each unknown in the order of elimination, shape (f,)."""
    owner: IntArray
    """Supernode of each unknown in the order of elimination, shape (f,)."""
    pool: Pool

    @property
    def size(self) -> int:
        return len(self.order)

    @property
    def factor_entries(self) -> int:
        return int(self.tree.offset[-1])

    def tallest(self, columns: int = 0) -> int:
        """Return the rows of the tallest front [unknowns], with at least so many nodes below each supernode."""
        tree = self.tree
        return int(3 * (np.diff(tree.firsts) + np.maximum(np.diff(tree.begin), columns)).max(initial=0))


def analyse(indptr: IntArray, indices: IntArray) -> Analysis:
    """Analyse the pattern of a symmetric matrix in CSC with sorted indices, whose unknowns are in an order of little fill."""
    _check_blocks(indptr, indices)
    heads, entries = np.asarray(indptr, np.int64), np.asarray(indices, np.int64)
    counts = np.diff(heads)[::3] // 3
    rows = np.concatenate([[0], np.cumsum(counts)])
    columns = entries[_ranges(heads[:-1:3], counts, 3)] // 3
    parent = _elimination_tree(rows, columns)
    order = _postorder(parent, np.argsort(np.diff(_structures(rows, columns, parent)[0])))
    inverse = np.empty_like(order)
    inverse[order] = np.arange(len(order))
    columns = inverse[columns[_ranges(rows[:-1][order], counts[order], 1)]]
    rows = np.concatenate([[0], np.cumsum(counts[order])])
    parent = np.where(parent[order] >= 0, inverse[parent[order]], -1)
    tree = _layout(heads, entries, order, inverse, rows, columns, parent)
    unknowns = (3 * order[:, None] + np.arange(3)).ravel()
    rank = np.empty_like(unknowns)
    rank[unknowns] = np.arange(len(unknowns))
    owner = np.repeat(np.arange(len(tree.parent)), 3 * np.diff(tree.firsts))
    return Analysis(tree, unknowns, rank, owner, Pool())


def _ranges(starts: IntArray, counts: IntArray, step: int) -> IntArray:
    """Return starts[0], starts[0] + step, … counts[0] times, then the same of starts[1], and so on."""
    ends = np.cumsum(counts)
    inner = np.arange(int(counts.sum()), dtype=np.int64) - np.repeat(ends - counts, counts)
    return np.asarray(np.repeat(starts, counts) + step * inner)


def _check_blocks(indptr: IntArray, indices: IntArray) -> None:
    """Raise InputError unless a pattern consists of full 3 × 3 blocks, which the compiled kernels take for granted."""
    counts = np.diff(indptr)[: (len(indptr) - 1) // 3 * 3].reshape(-1, 3)
    whole = (len(indptr) - 1) % 3 == 0 and (counts == counts[:, :1]).all() and (counts % 3 == 0).all()
    triples = np.asarray(indices).reshape(-1, 3) if whole else np.zeros((1, 3))
    if not (whole and (triples[:, 0] % 3 == 0).all() and (np.diff(triples, axis=1) == 1).all()):
        raise InputError("not a pattern of nodes", where="indices", found="single entries", expected="full blocks of 3 × 3")
