"""Phylogenetic trees: a reader of Newick and Nexus files, and covariances of Brownian motion along their branches."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.errors import FileFormatError, InputError
from shapespace.io.files import read_bytes
from shapespace.lazy import require_package
from shapespace.reprs import first_names, short_repr
from shapespace.types import FloatArray, IntArray, read_only

_LARGEST_BYTES = 2**24  # 16 MiB, a tree of more than 100,000 tips
_LONGEST_REASON = 120  # characters of a message of the parser, in a sentence
_MOST_NODES = 20_000  # of a file, whose parser then takes a second
_MOST_SPECIES = 2_000  # tips that are used; memory grows with their square
_NAMED = 4  # names in a message
_ROUNDED = 1e-5  # relative; branch lengths in files have about six digits
_NO_DISTANCE = 1e-9  # relative to the deepest tip


@dataclass(frozen=True, eq=False, kw_only=True)
class Tree:
    """A rooted phylogenetic tree with branch lengths; nodes with more than two children are accepted.

    Args:
        tips: T names.
        parents: (M,) parent of each node, -1 for the root. Nodes 0 to T - 1 are the tips in the order of `tips`, node T
            is the root, and each internal node comes after its parent.
        lengths: (M,) length of the branch above each node, in the unit of the file; 0 for the root.
        where: name of the tree in messages.
        notes: sentences about omitted or unusual parts of the tree.

    Example:
        >>> ss.io.Tree(tips=("a", "b"), parents=np.array([2, 2, -1]), lengths=np.array([1.0, 1.0, 0.0])).tips
        ('a', 'b')
    """

    tips: tuple[str, ...]
    parents: IntArray
    lengths: FloatArray
    where: str = "The tree"
    notes: tuple[str, ...] = ()

    __repr__ = short_repr

    @cached_property
    def paths(self) -> FloatArray:
        """(M, M) roots of the lengths of the branches (columns) from the root to each node (rows), 0 for others.

        Products with standard normal numbers are traits after Brownian motion of rate 1.
        """
        out = np.zeros((len(self.parents), len(self.parents)))
        for node in [*range(len(self.tips) + 1, len(self.parents)), *range(len(self.tips))]:
            out[node] = out[self.parents[node]]
            out[node, node] = np.sqrt(self.lengths[node])
        return read_only(out)

    @cached_property
    def covariance(self) -> FloatArray:
        """(T, T) lengths of the paths from the root that tips share: covariances of Brownian motion of rate 1."""
        own = self.paths[: len(self.tips)]
        return read_only(own @ own.T)

    @property
    def edges(self) -> IntArray:
        """(M - 1, 2) parent and child of each branch."""
        children = np.flatnonzero(self.parents >= 0)
        return np.column_stack([self.parents[children], children]).astype(np.int32)

    def matched(self, names: Sequence[str]) -> Tree:
        """Return the tree of some species: its tips are in the order of `names`, and other tips are pruned.

        Internal nodes that keep one child are removed, and the root is the last common ancestor. Blanks and
        underscores in names are the same, as in Newick.

        Raises:
            InputError: a name without a tip, two names of one tip, fewer than three names, too many, or tips without a
                distance between them.
        """
        index = {_key(tip): k for k, tip in enumerate(self.tips)}
        absent = [name for name in names if _key(name) not in index]
        if absent:
            raise InputError(
                f"{self.where} has no tip for {len(absent)} of {len(names)} shapes ({first_names(absent, _NAMED)}); "
                f"name shapes as tips ({first_names(self.tips, 2)}), or exclude these shapes."
            )
        kept, count = [index[_key(name)] for name in names], len(self.tips)
        if len(set(kept)) < len(kept) or not 3 <= len(kept) <= _MOST_SPECIES:
            raise InputError(
                f"{self.where}: {len(names)} shapes belong to {len(set(kept))} tips; an analysis on a tree needs one "
                f"shape for each tip, and 3 to {_MOST_SPECIES:,} shapes."
            )
        used, branches = np.isin(np.arange(len(self.parents)), kept), np.zeros(len(self.parents), dtype=np.intp)
        for node in [*range(count), *range(len(self.parents) - 1, count, -1)]:
            used[self.parents[node]] |= used[node]
            branches[self.parents[node]] += used[node]
        number = {old: new for new, old in enumerate([*kept, *(np.flatnonzero(branches > 1)).tolist()])}
        parents, lengths = np.full(len(number), -1, dtype=np.int32), np.zeros(len(number))
        for node, new in number.items():
            parent, length = int(self.parents[node]), float(self.lengths[node])
            while parent >= 0 and parent not in number:
                parent, length = int(self.parents[parent]), length + float(self.lengths[parent])
            if parent >= 0:
                parents[new], lengths[new] = number[parent], length
        tree = replace(self, tips=tuple(names), parents=parents, lengths=read_only(lengths))
        depths = np.diagonal(tree.covariance)
        distances = depths[:, None] + depths - 2 * tree.covariance
        np.fill_diagonal(distances, depths)
        first, second = (int(k) for k in np.unravel_index(distances.argmin(), distances.shape))
        if distances[first, second] <= _NO_DISTANCE * depths.max():
            ends = f"{names[first]} and {names[second] if first != second else 'the root'}"
            raise InputError(
                f"{self.where}: the distance between {ends} is 0, so the covariance of the species is singular; give "
                "their branches lengths above 0, or exclude one of the species."
            )
        notes = list(self.notes)
        if len(kept) < count:
            verbs = "has no shape and is" if count - len(kept) == 1 else "have no shape and are"
            notes.append(f"{self.where}: {count - len(kept)} of {count} tips {verbs} pruned.")
        if np.ptp(depths) > _ROUNDED * depths.max():
            notes.append(
                f"{self.where} is not ultrametric: tips are {depths.min():g} to {depths.max():g} from the root."
            )
        return replace(tree, notes=tuple(notes))


def read_tree(path: Path | str) -> Tree:
    """Read a rooted tree with branch lengths from a Newick or Nexus file; the first one of several.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is no tree, is too large, names a tip twice or not at all, or a branch has no length or a
            negative one.
        ShapespaceError: the extra `phylogeny` is not installed.

    Example:
        >>> ss.io.read_tree("tree.nwk").tips
        ('a', 'b', 'c', 'd', 'e', 'f')
    """
    path = Path(path)
    dendropy = require_package("dendropy", "A phylogenetic tree", "'shapespace[phylogeny]'")
    remedy = "write one rooted tree with branch lengths as Newick or Nexus"
    data = read_bytes(path, _LARGEST_BYTES)
    try:
        text = data.decode("utf-8-sig")
        schema = "nexus" if text.lstrip()[:6].lower() == "#nexus" else "newick"
        trees = iter(dendropy.Tree.yield_from_files([io.StringIO(text)], schema, preserve_underscores=True))
        found, has_more = next(trees, None), next(trees, None) is not None
    # The parser may raise any exception on invalid input; deep nesting is a RecursionError.
    except Exception as error:
        # The first sentence, without an explanation after a colon that is too long.
        reason = " ".join(str(error).split()).split(". ")[0].rstrip(".")
        reason = reason if len(reason) <= _LONGEST_REASON else reason[:_LONGEST_REASON].rpartition(":")[0] or "damaged"
        raise FileFormatError(f"{path} cannot be read as a tree ({reason}); {remedy}.") from error
    leaves: list[Any] = [] if found is None else list(found.leaf_node_iter())
    nodes = leaves if found is None else [*leaves, *found.preorder_internal_node_iter()]
    if len(leaves) < 2 or len(nodes) > _MOST_NODES:
        raise FileFormatError(
            f"{path} contains no tree, or one of {len(leaves):,} tips; {remedy}, of up to 10,000 tips."
        )
    tips = tuple("" if node.taxon is None else str(node.taxon.label) for node in leaves)
    counts = Counter(map(_key, tips))
    repeated = [tip for tip in tips if not tip or counts[_key(tip)] > 1]
    if repeated:
        problem = f"two tips are called {repeated[0][:60]!r}" if repeated[0] else "a tip has no name"
        raise FileFormatError(f"{path}: {problem}; give each tip its own name.")
    number = {id(node): k for k, node in enumerate(nodes)}
    parents = np.array([number.get(id(node.parent_node), -1) for node in nodes], dtype=np.int32)
    lengths = np.array([0.0 if node.parent_node is None else node.edge.length for node in nodes], dtype=np.float64)
    wrong = int((~(np.isfinite(lengths) & (lengths >= 0))).sum())
    if wrong:
        raise FileFormatError(
            f"{path}: {wrong} of {len(nodes) - 1} branches have no length or a negative one; give lengths from 0."
        )
    notes = (f"{path} contains several trees, and the first one is used.",) if has_more else ()
    return Tree(tips=tips, parents=parents, lengths=read_only(lengths), where=str(path), notes=notes)


def _key(name: str) -> str:
    return name.strip().replace(" ", "_")
