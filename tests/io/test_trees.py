"""Trees: Newick and Nexus against hand-computed paths, pruning against submatrices, and one sentence for bad files."""

from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io import trees
from shapespace.io.trees import Tree, read_tree

pytest.importorskip("dendropy", reason="the extra `phylogeny` is not installed")

NEWICK = "((a_1:1,'b 2':2)inner:3,(c:1.5,d:0.5,e:4):2)root:9;"
NEXUS = """#NEXUS
[a comment]
BEGIN TREES;
  TRANSLATE 1 a_1, 2 'b 2', 3 c, 4 d, 5 e;
  TREE best = [&R] ((1[&rate=0.1]:1,2:2):3,(3:1.5,4:0.5,5:4):2):9;
END;
"""
COVARIANCE = np.array([[4, 3, 0, 0, 0], [3, 5, 0, 0, 0], [0, 0, 3.5, 2, 2], [0, 0, 2, 2.5, 2], [0, 0, 2, 2, 6]])


def written(folder: Path, text: str) -> Path:
    path = folder / "tree.nwk"
    path.write_text(text)
    return path


@pytest.mark.parametrize("text", [NEWICK, NEXUS], ids=["newick", "nexus"])
def test_covariances_are_shared_paths_from_the_root(tmp_path: Path, text: str) -> None:
    tree = read_tree(written(tmp_path, text))
    assert tree.tips == ("a_1", "b 2", "c", "d", "e") and not tree.notes
    np.testing.assert_allclose(tree.covariance, COVARIANCE, atol=1e-12)
    assert tree.parents[5] == -1 and (tree.parents[6:] < np.arange(6, 8)).all()
    assert tree.edges.tolist() == [[6, 0], [6, 1], [7, 2], [7, 3], [7, 4], [5, 6], [5, 7]]
    shared = tree.paths[5:] @ tree.paths[:5].T
    np.testing.assert_allclose(shared, [[0, 0, 0, 0, 0], [3, 3, 0, 0, 0], [0, 0, 2, 2, 2]], atol=1e-12)


def test_tips_without_shape_are_pruned_and_the_root_is_the_last_common_ancestor(tmp_path: Path) -> None:
    tree = read_tree(written(tmp_path, NEWICK))
    some = tree.matched(["e", "b_2", "c"])
    np.testing.assert_allclose(some.covariance, COVARIANCE[np.ix_([4, 1, 2], [4, 1, 2])], atol=1e-12)
    assert some.tips == ("e", "b_2", "c") and len(some.parents) == 5
    assert "2 of 5 tips have no shape and are pruned" in some.notes[0]
    assert "1 of 5 tips has no shape and is pruned" in tree.matched(["a_1", "e", "b_2", "c"]).notes[0]
    within = tree.matched(["d", "c", "e"])
    np.testing.assert_allclose(within.covariance, np.diag([0.5, 1.5, 4.0]), atol=1e-12)


def test_tips_at_different_depths_are_accepted_with_a_note(tmp_path: Path) -> None:
    tree = read_tree(written(tmp_path, NEWICK)).matched(["a_1", "b_2", "c", "d", "e"])
    assert len(tree.notes) == 1 and "is not ultrametric: tips are 2.5 to 6 from the root" in tree.notes[0]
    even = read_tree(written(tmp_path, "((a:1,b:1):1.0000001,c:2,d:2);")).matched(["a", "b", "c", "d"])
    assert not even.notes


def test_the_first_of_several_trees_is_read_with_a_note(tmp_path: Path) -> None:
    tree = read_tree(written(tmp_path, "(a:1,b:2,c:3);\n(a:5,b:5,c:5);"))
    assert tree.lengths[:3].tolist() == [1, 2, 3] and "contains several trees" in tree.notes[0]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("(a:1,b,c:2);", "1 of 3 branches have no length"),
        ("(a:1,b:-1,c:2);", "1 of 3 branches"),
        ("(a:1,b:nan,c:1e999);", "2 of 3 branches"),
        ("((a:1,b:1):1,a:2);", "a"),
        ("((a b:1,c:1):1,a_b:2);", "cannot be read as a tree"),
        ("(('a b':1,c:1):1,a_b:2);", "two tips are called 'a b'"),
        ("(:1,b:1,c:1);", "a tip has no name"),
        ("((a:1,b:1):1,c:2", "cannot be read as a tree"),
        ("(" * 5000 + "a:1" + ")" * 5000 + ";", "cannot be read as a tree"),
        ("(a:1,b:x,c:2);", "Invalid edge length"),
        ("a;", "contains no tree"),
        ("specimen,sex\na,f\n", "tree"),
        ("#NEXUS\nBEGIN DATA; END;", "contains no tree"),
        ("", "cannot be read as a tree"),
    ],
)
def test_what_is_no_tree_is_refused_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        read_tree(written(tmp_path, text))
    assert sentence in str(caught.value) and "tree.nwk" in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_absent_binary_or_too_large_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileError, match="there is no such file"):
        read_tree(tmp_path / "none.nwk")
    (tmp_path / "binary.nwk").write_bytes(b"\xff\xfe\x00(")
    with pytest.raises(FileFormatError, match="cannot be read as a tree"):
        read_tree(tmp_path / "binary.nwk")
    path = written(tmp_path, NEWICK)
    monkeypatch.setattr(trees, "_LARGEST_BYTES", 10)
    with pytest.raises(FileError, match="the limit for such files is"):
        read_tree(path)


def tree_of(lengths: list[float]) -> Tree:
    """Return the star of a, b, c and d, with the last two on one branch more."""
    return Tree(
        tips=("a", "b", "c", "d"), parents=np.array([4, 4, 5, 5, -1, 4], dtype=np.int32), lengths=np.array(lengths)
    )


def test_species_that_do_not_match_the_tips_are_refused_by_name() -> None:
    tree = tree_of([1, 1, 1, 1, 0, 1])
    with pytest.raises(InputError, match=r"no tip for 2 of 4 shapes \(x, y\)"):
        tree.matched(["a", "x", "b", "y"])
    with pytest.raises(InputError, match="4 shapes belong to 3 tips"):
        tree.matched(["a", "b", "c", "c"])
    with pytest.raises(InputError, match="one shape for each tip, and 3 to"):
        tree.matched(["a", "b"])


def test_tips_without_distance_between_them_are_refused_by_name() -> None:
    with pytest.raises(InputError, match="between c and d is 0"):
        tree_of([1, 1, 0, 0, 0, 1]).matched(["a", "b", "c", "d"])
    with pytest.raises(InputError, match="between a and the root is 0"):
        tree_of([0, 1, 1, 1, 0, 1]).matched(["a", "b", "c", "d"])
    # A branch of length 0 between internal nodes is a multifurcation.
    assert tree_of([1, 1, 1, 1, 0, 0]).matched(["a", "b", "c", "d"]).covariance.tolist() == np.eye(4).tolist()
