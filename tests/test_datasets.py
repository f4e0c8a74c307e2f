"""The data sets are what their docstrings say."""

import importlib.util
import sys
from collections import Counter

import numpy as np
import pytest

from numpyro_bridges import datasets
from numpyro_bridges.shapes import align_start, procrustes_align, rms_radius

needs_ktch = pytest.mark.skipif(
    importlib.util.find_spec("ktch") is None, reason="ktch is not installed"
)


def check_in_register(shapes, num_shapes, num_points):
    """Centred, of unit RMS radius, counter-clockwise, rotated onto the mean, which is their own."""
    assert shapes.points.shape == (num_shapes, num_points, 2) and shapes.mean.shape == (
        num_points,
        2,
    )
    assert len(shapes.labels) == len(shapes.names) == len(set(shapes.names)) == num_shapes
    everything = np.concatenate([shapes.points, shapes.mean[None]])
    np.testing.assert_allclose(everything.mean(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(rms_radius(everything), 1.0)
    x, y = np.moveaxis(everything, -1, 0)
    assert np.all(np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1) > 0.0)
    average = shapes.points.mean(axis=0)
    np.testing.assert_allclose(shapes.mean, average / rms_radius(average), atol=1e-9)
    again = procrustes_align(shapes.points, reference=shapes.mean)
    np.testing.assert_allclose(again.shapes, shapes.points, atol=1e-8)


@needs_ktch
@pytest.mark.parametrize(("genus", "num_shapes"), [("CX", 25), ("TO", 1), (None, 126)])
def test_wings(genus, num_shapes):
    wings = datasets.mosquito_wings(num_points=32, genus=genus)
    check_in_register(wings, num_shapes, 32)
    assert genus is None or set(wings.labels) == {genus}
    assert all(
        name.startswith(f"{label} ") for name, label in zip(wings.names, wings.labels, strict=True)
    )
    steps = np.linalg.norm(np.roll(wings.points, -1, axis=1) - wings.points, axis=-1)
    assert steps.max() < 1.1 * np.median(steps) and steps.min() > 0.7 * np.median(steps)


@needs_ktch
def test_wings_start_at_the_hinge_and_lie_along_x():
    wings = datasets.mosquito_wings(num_points=24)
    assert np.sum(wings.mean[:, 0] * wings.mean[:, 1]) == pytest.approx(0.0, abs=1e-12)
    assert wings.mean[:, 0].std() > 2.0 * wings.mean[:, 1].std()
    assert wings.points[:, 0, 0].min() > 1.4 and wings.points[:, 0, 1].min() > 0.15
    for outline in wings.points:  # no other numbering of the points is nearer to the mean
        np.testing.assert_array_equal(align_start(outline, wings.mean), outline)


@needs_ktch
def test_wings_by_genus_are_counted_as_the_docstring_says():
    counts = Counter(datasets.mosquito_wings(num_points=3).labels)
    said = " ".join(datasets.mosquito_wings.__doc__.split())
    for code, count in counts.items():
        assert f"`{code}`, *{datasets.GENERA[code]}*" in said
        assert f"{count} of `{code}`" in said or list(counts.values()).count(count) > 1
    assert "4 each of `UR`" in said and counts["UR"] == counts["WY"] == 4
    assert "1 each of `DE`" in said
    assert [code for code, count in counts.items() if count == 1] == ["TO", "OR", "DE"]


@needs_ktch
def test_unknown_genus_lists_the_known_ones():
    with pytest.raises(
        ValueError,
        match=r"`genus` must be one of 'AE', Aedes \(57\), 'CX', Culex \(25\), .*; got 'Culix'",
    ):
        datasets.mosquito_wings(genus="Culix")


@needs_ktch
def test_a_genus_has_a_name_and_a_code():
    named, coded = (datasets.mosquito_wings(num_points=8, genus=g) for g in ("Wyeomyia", "WY"))
    assert named.names == coded.names and len(named.names) == 4


@needs_ktch
def test_ktch_itself_is_not_imported(monkeypatch):
    monkeypatch.delitem(sys.modules, "ktch", raising=False)
    datasets.mosquito_wings(genus="CX")
    assert "ktch" not in sys.modules


def test_without_ktch(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"`ktch`.*pip install 'numpyro_bridges\[examples\]'"):
        datasets.mosquito_wings()


def test_mosquito_tree():
    """Clades as published, and Grafen's heights: the number of tips below a node, less one, in
    units of the root's.
    """
    tree = datasets.mosquito_tree()
    assert set(tree.observed_names) == set("AE AN CA CX DE MA OR PS TO UR WY".split())
    below = {
        node: [tip for tip in tree.tips if node in lineage(tree, tip)]
        for node in range(tree.num_nodes)
    }
    clades = {
        "".join(sorted(tree.names[tip] for tip in tips))
        for tips in below.values()
        if 1 < len(tips) < 11
    }
    deeper = {"AECACXDEMAORPSTOURWY", "AECACXDEMAORPSTOWY", "CACXDEMAORTOWY", "CAMAORTOWY"}
    assert clades == deeper | {"CAMAOR", "CAOR", "TOWY", "CXDE", "AEPS"}
    ages = [(len(below[node]) - 1) / 10 for node in range(tree.num_nodes)]
    np.testing.assert_allclose(tree.ages, ages, atol=1e-6)
    names = {name: node for node, name in enumerate(tree.names) if name}
    assert {tree.names[tip] for tip in below[names["Culicini"]]} == {"CX", "DE"}
    assert {tree.names[tip] for tip in below[names["Aedini"]]} == {"AE", "PS"}
    assert len(below[names["Culicinae"]]) == 10


def lineage(tree, node):
    nodes = [node]
    while nodes[-1] > 0:
        nodes.append(tree.parents[nodes[-1]])
    return nodes


@needs_ktch
def test_tips_of_the_tree_are_the_genera_of_the_wings():
    assert set(datasets.mosquito_wings(num_points=3).labels) == set(
        datasets.mosquito_tree().observed_names
    )


def test_ellipses():
    shapes = datasets.ellipses(num_points=16, aspects=(1.0, 2.0))
    check_in_register(shapes, 2, 16)
    angles = 2.0 * np.pi * np.arange(16) / 16
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    np.testing.assert_allclose(shapes.points[0], circle, atol=1e-5)
    extent = np.ptp(shapes.points[1], axis=0)
    assert extent[0] / extent[1] == pytest.approx(2.0, rel=1e-3)
    assert shapes.labels == ("1", "2")


@pytest.mark.parametrize("make", [datasets.mosquito_wings, datasets.ellipses])
def test_too_few_points(make):
    with pytest.raises(ValueError, match="`num_points` must be an integer, at least 3; got 2"):
        make(num_points=2)


@pytest.mark.parametrize("aspects", [(), (1.0, 0.0)])
def test_wrong_aspects(aspects):
    with pytest.raises(ValueError, match="`aspects` must be one or more ratios from 1e-6"):
        datasets.ellipses(aspects=aspects)
