"""Trees: what is read and what is refused; times, clades and pruning against walks over
dictionaries.
"""

import io as text_io
from types import SimpleNamespace

import dendropy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import numpyro_bridges as nb
from numpyro_bridges import io

ABC = "((a:1,b:1.5):2,c:3);"


def tips_of(tree):
    return [tree.names[i] for i in tree.tips]


def depth_of(tree, name):
    return float(tree.depths[tree.names.index(name)])


READ = {
    "plain": (ABC, ["a", "b", "c"], [3.0, 3.5, 3.0]),
    "unifurcation": ("((a:1,b:1):1,(c:1):1);", ["a", "b", "c"], [2.0, 2.0, 2.0]),
    "quotes": (
        "('H. sapiens (1)':1,'Fred''s [sp.]':2);",
        ["H. sapiens (1)", "Fred's [sp.]"],
        [1.0, 2.0],
    ),
    "underscores": (
        "(Mus_musculus:1,Homo_sapiens:1);",
        ["Mus_musculus", "Homo_sapiens"],
        [1.0, 1.0],
    ),
    "annotations": (
        "[&R] ((a[&rate=0.1]:1,b:1.0E-2)[&h={0.1,0.2}]:1,[x]'c d':2):0.5;",
        ["a", "b", "c d"],
        [2.5, 1.51, 2.5],
    ),
    "wrapped root": ("((a:1,b:1):10);", ["a", "b"], [11.0, 11.0]),
    "supports": ("((a:1,b:1)95:1,(c:1,d:1)0.98/100:1);", ["a", "b", "c", "d"], [2.0] * 4),
    "zero length": ("((a:1,b:1):1,c:0);", ["a", "b", "c"], [2.0, 2.0, 0.0]),
    "lines": ("((a:1,\n b:1):1,c:2)\n;\n", ["a", "b", "c"], [2.0, 2.0, 2.0]),
    "no semicolon": ("((a:1,b:1):1,c:2)", ["a", "b", "c"], [2.0, 2.0, 2.0]),
    "one branch": ("a:1;", ["a"], [1.0]),
    "polytomy": (
        "(a:1,b:2,(c:1,d:1,e:1):1);",
        ["a", "b", "c", "d", "e"],
        [1.0, 2.0, 2.0, 2.0, 2.0],
    ),
    "nexus": (
        "#NEXUS\nBEGIN TREES;\nTRANSLATE 1 'A. x', 2 b, 3 c;\nTREE t = [&R] "
        "((1:1,2:1):1,3:2);\nEND;",
        ["A. x", "b", "c"],
        [2.0, 2.0, 2.0],
    ),
}


@pytest.mark.parametrize("name", READ)
def test_what_is_read(name):
    text, tips, depths = READ[name]
    tree = nb.Tree.from_newick(text)
    assert tips_of(tree) == tips and tree.observed_names == tuple(tips)
    np.testing.assert_allclose([depth_of(tree, tip) for tip in tips], depths, rtol=1e-12)
    inner = set(range(tree.num_nodes)) - set(tree.tips)
    assert all(tree.names[i] is None for i in inner)


def test_the_time_before_the_first_split_is_kept():
    for text in ("((a:1,b:1):0.5);", "(a:1,b:1):0.5;"):
        tree = nb.Tree.from_newick(text)
        assert tree.parents == (-1, 0, 1, 1)
        np.testing.assert_allclose(tree.lengths, [0.5, 1.0, 1.0])
    assert nb.Tree.from_newick("(a:1,b:1):0;").parents == (-1, 0, 0)


def test_settings_of_reading(tmp_path):
    blanks = nb.Tree.from_newick("(Mus_musculus:1,'a_b':1);", preserve_underscores=False)
    assert tips_of(blanks) == ["Mus musculus", "a_b"]
    unit = nb.Tree.from_newick("(a,(b:9,c));", unit_lengths=True)
    np.testing.assert_allclose(unit.depths, [0.0, 1.0, 1.0, 2.0, 2.0])
    file = tmp_path / "trees.nwk"
    file.write_text("(a:1,b:1);\n(x:1,(y:1,z:1)w:1);\n", encoding="utf-8-sig")
    assert tips_of(nb.Tree.from_newick(file, index=1)) == ["x", "y", "z"]
    assert nb.Tree.from_newick(str(file), index=1).names[2] == "w"


REFUSED = {
    "blank in a name": ("(A. gracilis:1,b:1);", r"line 1 at column \d+: .*needs quotes"),
    "a length is missing": ("(a:1,(b,c:1):1);", "the one above `b` has none, 1 in all"),
    "no lengths": ("(a,(b,c));", "above `a` has none, 4 in all.*`unit_lengths=True`"),
    "a name twice": ("(a:1,a:1,b:1);", "`names` must differ; 'a' is given more than once"),
    "a negative length": ("((a:1,b:1):-0.1,c:1);", "above node 1, which leads to a, b has -0.1"),
    "an infinite length": ("(a:inf,b:1);", "above `a` has inf"),
    "two lengths": ("((a:1,b:1),\nc:2:1);", "two lengths, line 2, column 4"),
    "a parenthesis": ("((a:1,b:1:1);", "two lengths|Newick"),
    "not closed": ("((a:1,b:1);", "`source` must be Newick or NEXUS"),
    "several": (
        "(a:1,b:1);(c:1,d:1);",
        "holds 2 trees where one is asked for: choose one by `index`",
    ),
    "empty": (";", "`source` must|at least two nodes"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused(name):
    text, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        nb.Tree.from_newick(text)


def test_errors_name_the_file(tmp_path):
    file = tmp_path / "two.nwk"
    file.write_text("(a:1,b:1);(c:1,d:1);")
    with pytest.raises(ValueError, match="two.nwk.*holds 2 trees"):
        nb.Tree.from_newick(file)
    with pytest.raises(ValueError, match="`index` must be below the number of trees, 2; got 2"):
        nb.Tree.from_newick(file, index=2)
    with pytest.raises(FileNotFoundError):
        nb.Tree.from_newick(tmp_path / "none.nwk")


def random_tree(rng, count):
    """Parents in any order, lengths of which some are 0, names."""
    order = rng.permutation(count)
    parents = np.full(count, -1)
    for i in range(1, count):
        parents[order[i]] = order[rng.integers(max(0, i - 4), i)]
    return (
        parents,
        np.where(rng.random(count) < 0.2, 0.0, rng.exponential(size=count)),
        [f"n{i}" for i in range(count)],
    )


@pytest.mark.parametrize("count", [2, 3, 40, 300])
def test_times_clades_and_pruning(count):
    """Against walks from node to parent, by name; the order of the nodes given makes no difference."""
    rng = np.random.default_rng(count)
    parents, lengths, names = random_tree(rng, count)
    tree = nb.Tree.from_parents(parents, lengths, names)

    def lineage(i):
        return [i] if parents[i] == -1 else [i, *lineage(parents[i])]

    depth = {names[i]: sum(lengths[j] for j in lineage(i)[:-1]) for i in range(count)}
    np.testing.assert_allclose(tree.depths, [depth[name] for name in tree.names], atol=1e-12)
    np.testing.assert_allclose(tree.ages, max(depth.values()) - tree.depths, atol=1e-12)
    np.testing.assert_allclose(tree.height, max(depth.values()))
    assert tree.parents[0] == -1 and all(parent < i for i, parent in enumerate(tree.parents))
    above = [names[parents[names.index(name)]] for name in tree.names[1:]]
    assert above == [tree.names[parent] for parent in tree.parents[1:]]

    tips = [tree.names[i] for i in tree.tips]
    assert set(tips) == {names[i] for i in range(count) if i not in set(parents)}
    some = list(rng.choice(tips, min(3, len(tips)), replace=False))
    shared = set.intersection(*(set(lineage(names.index(name))) for name in some))
    ancestor = max(shared, key=lambda i: len(lineage(i)))
    inside = [ancestor in lineage(names.index(name)) for name in tree.names[1:]]
    stem = [name == names[ancestor] for name in tree.names[1:]]
    assert np.array_equal(tree.clade(*some), inside)
    assert np.array_equal(tree.clade(*some, stem=False), np.array(inside) & ~np.array(stem, bool))

    small = tree.pruned(some)
    assert [small.names[i] for i in small.tips] == [name for name in tips if name in some]
    np.testing.assert_allclose(
        [depth_of(small, name) for name in some], [depth[name] for name in some], atol=1e-12
    )
    splits = [sum(parent == i for parent in small.parents) for i in range(1, small.num_nodes)]
    assert 1 not in splits


def test_as_dendropy_has_it():
    """Distances between tips, which know topology and lengths."""
    rng = np.random.default_rng(5)
    parents, lengths, names = random_tree(rng, 30)
    tree = nb.Tree.from_parents(parents, lengths, names)

    def newick(i):
        below = [newick(j) for j in range(30) if parents[j] == i]
        return (f"({','.join(below)})" if below else "") + f"{names[i]}:{float(lengths[i])!r}"

    text = newick(int(np.flatnonzero(parents == -1)[0])) + ";"
    theirs = dendropy.Tree.get(
        file=text_io.StringIO(text), schema="newick"
    ).phylogenetic_distance_matrix()
    taxa = {taxon.label: taxon for taxon in theirs.taxon_iter()}
    read = nb.Tree.from_newick(text)
    for ours in (tree, read):
        tips = [ours.names[i] for i in ours.tips]
        for first in tips[:6]:
            for second in tips[:6]:
                branches = on_the_way(ours, first) ^ on_the_way(ours, second)
                found = float(np.sum(np.asarray(ours.lengths)[branches]))
                np.testing.assert_allclose(found, theirs(taxa[first], taxa[second]), atol=1e-12)


def on_the_way(tree, name):
    branches = np.zeros(tree.num_nodes - 1, bool)
    node = tree.names.index(name)
    while node:
        branches[node - 1] = True
        node = tree.parents[node]
    return branches


def test_lengths_are_parameters():
    """Traced, differentiable, and part of no program's shape."""
    tree = nb.Tree.from_newick(ABC)
    fast, traced = tree.clade("a", "b"), []

    @jax.jit
    def depths(tree, rate):
        traced.append(rate)
        return tree.scaled(jnp.where(fast, rate, 1.0)).depths

    np.testing.assert_allclose(depths(tree, 2.0), [0.0, 4.0, 6.0, 7.0, 3.0])
    np.testing.assert_allclose(
        depths(tree.with_lengths([1.0, 1.0, 1.0, 5.0]), 3.0), [0.0, 3.0, 6.0, 6.0, 5.0]
    )
    assert len(traced) == 1
    slope = jax.grad(lambda lengths: tree.with_lengths(lengths).pruned(["a", "c"]).depths[1])(
        tree.lengths
    )
    np.testing.assert_allclose(slope, [1.0, 1.0, 0.0, 0.0])
    stack = jax.vmap(lambda scale: tree.scaled(scale))(np.array([1.0, 2.0]))
    np.testing.assert_allclose(stack.lengths, np.outer([1.0, 2.0], tree.lengths))


def test_chains_and_stars():
    chain = nb.Tree.chain([0.5, 1.0, 3.0], ["young", "old", "oldest"])
    np.testing.assert_allclose(chain.depths, [0.0, 0.5, 1.0, 3.0])
    assert chain.observed_names == ("young", "old", "oldest") and chain.tips == (3,)
    star = nb.Tree.star([1.0, 2.0], ["a", "b"])
    np.testing.assert_allclose(star.depths, [0.0, 1.0, 2.0])
    assert star.observed == (1, 2) and nb.Tree.star([1.0]).names == (None, None)


def test_inner_nodes_and_fossils_are_seen_where_it_is_said():
    tree = nb.Tree.from_newick("((a:1,b:1)old:2,c:3);")
    assert tree.observing(["c", "old"]).observed_names == ("old", "c")
    assert tree.observing({"a": 0, "b": 0}).scaled(2.0).observed_names == ("a", "b")


SHAPES = {"c": [[3.0, 0.0]], "a": [[1.0, 0.0]], "b": [[2.0, 0.0]]}


def test_rows_by_name():
    tree = nb.Tree.from_newick(ABC)
    expected = [[[1.0, 0.0]], [[2.0, 0.0]], [[3.0, 0.0]]]
    specimens = [io.Specimen(np.asarray(shape), id=name) for name, shape in SHAPES.items()]
    array = np.array(list(SHAPES.values()))
    for rows in (tree.rows(SHAPES), tree.rows(specimens), tree.rows(array, names=list(SHAPES))):
        assert np.array_equal(rows, expected)
    assert np.array_equal(tree.observing(["c", "a"]).rows({"c": 1.0, "a": 2.0}), [2.0, 1.0])


def test_several_rows_of_a_node():
    """By name, in the order given; nodes in preorder."""
    names, values = ["c", "a", "c", "b", "c"], np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    tree = nb.Tree.from_newick(ABC).observing(names)
    assert (
        tree.observed_names == ("a", "b", "c", "c", "c")
        and tree.scaled(2.0).observed == tree.observed
    )
    specimens = [
        io.Specimen(np.full((1, 2), value), id=name)
        for name, value in zip(names, values, strict=True)
    ]
    for rows in (
        tree.rows(values, names=names),
        tree.rows({"b": 4.0, "c": [1.0, 3.0, 5.0], "a": 2.0}),
        tree.rows(specimens)[:, 0, 1],
    ):
        assert np.array_equal(rows, [2.0, 4.0, 1.0, 3.0, 5.0])


def without(**changes):
    return {name: changes.get(name, shape) for name, shape in SHAPES.items()}


ROWS = {
    "both sides": (
        {"a": 1.0, "B": 1.0, "d": 1.0},
        r"Without data: b, c\. Without a node: B, d\.",
    ),
    "a spelling": (
        {"A. marvortium": 1.0, "A. tigrinum": 1.0},
        r"Perhaps 'A\. marvortium' for 'A\. mavortium'\?",
    ),
    "blanks": (
        {"Mus musculus": 1.0},
        "Perhaps 'Mus musculus' for 'Mus_musculus'.*preserve_underscores=False",
    ),
    "fewer": (
        {"a": 1.0},
        r"Without data: b, c\. Tips without data are left out by `tree.observing\(data\)`",
    ),
    "another shape": (
        without(b=[[1.0, 2.0], [3.0, 4.0]]),
        r"one shape; 'a' has \(1, 2\) and 'b' has \(2, 2\)",
    ),
    "text": (without(b="x"), r"`data\['b'\]` must be a number"),
    "no specimens": ([1.0, 2.0, 3.0], r"`data\[0\]` must be a `Specimen`; an array needs `names=`"),
}


@pytest.mark.parametrize("name", ROWS)
def test_rows_that_do_not_fit(name):
    data, message = ROWS[name]
    text = {
        "a spelling": "('A. mavortium':1,'A. tigrinum':1);",
        "blanks": "(Mus_musculus:1,a:1);",
    }.get(name, ABC)
    with pytest.raises(ValueError, match=message):
        nb.Tree.from_newick(text).rows(data)


def test_rows_of_an_array():
    tree = nb.Tree.from_newick(ABC)
    with pytest.raises(ValueError, match="`names` must be one for each row of `data`, 3; got 2"):
        tree.rows(np.ones((3, 2)), names=["a", "b"])
    with pytest.raises(
        ValueError, match="have 2 rows of 'a', which the tree sees 1 times. `tree.observing"
    ):
        tree.rows(np.ones((4, 2)), names=["a", "a", "b", "c"])
    with pytest.raises(ValueError, match=r"Without data: c\. Without a node: A"):
        tree.observing(["c", "a", "a"]).rows(np.ones((3, 2)), names=["a", "A", "a"])
    with pytest.raises(ValueError, match=r"`data\['a'\]` must have an axis of rows in front"):
        tree.observing(["a", "a"]).rows({"a": 1.0})
    with pytest.raises(
        ValueError, match="the seen nodes must have names.*node 1, which leads to 1 has none"
    ):
        nb.Tree.star([1.0, 2.0]).rows({"a": 1.0})


WRONG = {
    "no root": (lambda: nb.Tree.from_parents([1, 0], [1.0, 1.0]), "one root, of parent −1; got 0"),
    "two roots": (
        lambda: nb.Tree.from_parents([-1, -1], [1.0, 1.0]),
        "one root, of parent −1; got 2",
    ),
    "a circle": (
        lambda: nb.Tree.from_parents([-1, 2, 1], np.ones(3)),
        r"nodes \[1, 2\] run in a circle",
    ),
    "a number": (
        lambda: nb.Tree.from_parents([-1, 5], np.ones(2)),
        r"numbers of nodes, from 0 to 1.*got \[5",
    ),
    "order": (lambda: nb.Tree([1, -1], [1.0]), "`parents` must be in preorder"),
    "blocks": (lambda: nb.Tree([-1, 0, 0, 1], np.ones(3)), "`parents` must be in preorder"),
    "lengths": (
        lambda: nb.Tree([-1, 0, 0], [1.0]),
        r"`lengths` must be one for each branch, \(2,\).*got shape \(1,\)",
    ),
    "NaN": (lambda: nb.Tree.star([1.0, np.nan], ["a", "b"]), "above `b` has nan"),
    "names": (lambda: nb.Tree.star([1.0, 1.0], ["a"]), "`names` must be one for each of 2 nodes"),
    "no text": (lambda: nb.Tree.star([1.0], [3]), "`names` must be texts, or None; got 3"),
    "times": (lambda: nb.Tree.chain([1.0, 0.5]), "`times` must not decrease"),
    "early": (
        lambda: nb.Tree.chain([-1.0, 0.5]),
        "`times` must not decrease, from 0 at the root on",
    ),
    "rates": (
        lambda: nb.Tree.star([1.0]).scaled([1.0, 2.0]),
        r"`rates` must be one number, or one for each branch",
    ),
    "observed": (
        lambda: nb.Tree([-1, 0], [1.0], None, [2]),
        "`observed` must be numbers of nodes, from 0 to 1",
    ),
    "nobody": (
        lambda: nb.Tree.from_newick(ABC).observing(["aa"]),
        r"it has no 'aa'\. Near it: 'a'",
    ),
    "no tip": (lambda: nb.Tree.from_newick("((a:1,b:1)x:1,c:1);").pruned(["x"]), "`x` is no tip"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_trees(name):
    make, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        make()


TREES = {
    "papilio": (5, None),
    "morpho": (30, "forewing_means_20.csv"),
    "tyrannus": (13, "species_means.csv"),
}


@pytest.mark.parametrize("folder", TREES)
def test_published_trees(folder, shared_data):
    """They have the tips that their pages say, and their tables match them by name."""
    count, table = TREES[folder]
    tree = nb.Tree.from_newick(shared_data / folder / "tree.nwk")
    assert len(tree.tips) == count
    if table:  # these two are dated
        np.testing.assert_allclose(
            np.asarray(tree.ages)[list(tree.tips)], 0.0, atol=1e-3 * float(tree.height)
        )
        lines = (shared_data / folder / table).read_text().splitlines()
        names = {line.split(",")[0]: float(line.split(",")[2]) for line in lines[1:]}
        assert tree.rows(names).shape == (count,)


def test_anything_with_landmarks_and_an_id_is_a_specimen():
    named = [
        SimpleNamespace(id=name, landmarks=np.asarray(shape)) for name, shape in SHAPES.items()
    ]
    assert nb.Tree.from_newick(ABC).rows(named).shape == (3, 1, 2)
