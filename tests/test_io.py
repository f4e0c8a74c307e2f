"""Reading and writing of tps and CSV files, and what is said about broken ones."""

import gzip
import re

import numpy as np
import pytest

from numpyro_bridges.io import Specimen, read_csv, read_tps, write_csv, write_tps


@pytest.fixture
def file(tmp_path):
    """A function that writes text or bytes to a new file and returns its path."""

    def write(content, name="shapes.tps"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def assert_same(found, expected):
    assert len(found) == len(expected)
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.landmarks, two.landmarks)
        assert len(one.curves) == len(two.curves)
        for curve, other in zip(one.curves, two.curves, strict=True):
            np.testing.assert_array_equal(curve, other)
        assert (one.id, one.image, one.scale) == (two.id, two.image, two.scale)
        assert dict(one.notes) == dict(two.notes)


FULL = """LM=2
1 2
3.5 -4e-1
CURVES=2
POINTS=1
0 0
POINTS=2
1 1
2 2
IMAGE=a b=c.jpg
ID=first
SCALE=0.0125
COMMENT=seen twice
comment=by two people
VARIABLES=sex=f
LM=0
CURVES=1
POINTS=1
7 8
ID=second
"""


class TestReadTps:
    def test_everything_at_once(self, file):
        one, two = read_tps(file(FULL))
        np.testing.assert_array_equal(one.landmarks, [[1, 2], [3.5, -0.4]])
        assert [curve.tolist() for curve in one.curves] == [[[0, 0]], [[1, 1], [2, 2]]]
        assert (one.id, one.image, one.scale) == ("first", "a b=c.jpg", 0.0125)
        assert one.notes == {"COMMENT": "seen twice\nby two people", "VARIABLES": "sex=f"}
        assert two.landmarks.shape == (0, 2) and (two.id, two.image, two.scale) == ("second", None, None)

    @pytest.mark.parametrize(
        "change",
        [
            lambda text: text.replace("\n", "\r\n"),
            lambda text: text.replace("\n", "\r"),
            lambda text: text.replace("\n", " \t\n"),
            lambda text: text.replace("\n", "\n\n"),
            lambda text: text.rstrip("\n"),
            lambda text: "\ufeff" + text,
            lambda text: re.sub(r"(?m)^(\w+)=", lambda key: key[1].lower() + " = ", text),
            lambda text: text.replace("3.5 -4e-1", "\t3.5 \t -.4"),
        ],
        ids="crlf cr trailing blank-lines no-final-newline bom case-and-blanks tabs".split(),
    )
    def test_forms_of_the_same_file(self, file, change):
        assert_same(read_tps(file(change(FULL))), read_tps(file(FULL, "plain.tps")))

    def test_three_dimensions(self, file):
        (one,) = read_tps(file("LM3=2\n1 2 3\n4 5 6\nCURVES=1\nPOINTS=1\n7 8 9\n"))
        assert one.landmarks.tolist() == [[1, 2, 3], [4, 5, 6]] and one.curves[0].tolist() == [[7, 8, 9]]

    def test_missing_values(self, file):
        path = file("LM=4\nNA NA\n-1 5\nnan 3\n0 0\nCURVES=1\nPOINTS=1\n-2 -2\n")
        (plain,) = read_tps(path)
        nan = np.nan
        np.testing.assert_array_equal(plain.landmarks, [[nan, nan], [-1, 5], [nan, 3], [0, 0]])
        (digitised,) = read_tps(path, negative_is_missing=True)
        np.testing.assert_array_equal(digitised.landmarks, [[nan, nan], [nan, nan], [nan, 3], [0, 0]])
        assert digitised.curves[0].tolist() == [[-2, -2]]

    def test_encoding(self, file):
        path = file("LM=1\n0 0\nID=Käfer\n".encode("cp1252"))
        with pytest.raises(ValueError, match=r"shapes.tps: expected text .*'utf-8', found byte 0xe4. Pass its"):
            read_tps(path)
        assert read_tps(path, encoding="cp1252")[0].id == "Käfer"

    @pytest.mark.parametrize(
        ("content", "line", "message"),
        [
            ("", 1, "expected LM= or LM3=, found an empty file"),
            ("\n \n", 1, "an empty file"),
            ("ID=a\n", 1, r"expected LM= or LM3=, found 'ID=a'"),
            ("<html>\n", 1, "A specimen begins with LM="),
            ("LM=two\n", 1, "expected a whole number after LM=, found 'LM=two'"),
            ("LM=-1\n", 1, "a whole number"),
            (
                "LM=2\n1 1\n",
                3,
                "expected point 2 of 2, found the end of the file. The block LM=2 .* cut short",
            ),
            ("LM=2\n1 1\nID=a\n", 3, "expected point 2 of 2, found 'ID=a'"),
            ("LM=1\n1 1\n2 2\nID=a\n", 3, "found '2 2'. .*as many as these say"),
            ("LM=1\n1 1\nRADII=1\n0.5\n", 4, "found '0.5'"),
            ("LM=1\n1 1 1\n", 2, "expected 2 numbers for point 1 of 1, found '1 1 1'. .*LM3= for three"),
            ("LM3=1\n1 1\n", 2, "expected 3 numbers"),
            ("LM=1\n1,5 2,5\n", 2, "expected a finite number, found '1,5'. Write decimals with a point"),
            ("LM=1\n1 x\n", 2, "found 'x'"),
            ("LM=1\n1 inf\n", 2, "found 'inf'"),
            ("LM=1\n1 1_0\n", 2, "found '1_0'"),
            ("LM=0\nSCALE=\n", 2, "expected a finite number, found ''"),
            ("LM=0\nSCALE=NA\n", 2, "expected a finite number, found 'NA'"),
            ("LM=0\nID=a\n\nID=b\n", 4, "expected ID= once for the specimen from line 1, found 'ID=b'"),
            ("LM=0\nCURVES=0\nCURVES=0\n", 3, "expected CURVES= once"),
            ("LM=0\nPOINTS=1\n1 1\n", 2, "expected CURVES= before POINTS="),
            ("LM=0\nCURVES=1\nPOINTS=1\n1 1\nPOINTS=1\n2 2\n", 5, "CURVES= gives the number of POINTS="),
            ("LM=0\nCURVES=2\nPOINTS=1\n1 1\nLM=0\n", 5, "expected POINTS= of curve 2 of 2, found 'LM=0'"),
            ("LM=0\nCURVES=1\nPOINTS=2\n1 1\nID=a\n", 5, "point 2 of 2, found 'ID=a'. The block POINTS=2"),
            ("LM=0\r\n\r\nCURVES=1\r\n", 4, "expected POINTS= .* found the end of the file"),
        ],
    )
    def test_errors_name_file_line_and_cure(self, file, content, line, message):
        with pytest.raises(ValueError, match=rf"(?s)shapes\.tps, line {line}: .*{message}"):
            read_tps(file(content))


class TestWriteTps:
    def test_round_trip(self, file, tmp_path):
        rng = np.random.default_rng(1)
        nan = np.nan
        specimens = read_tps(file(FULL)) + [
            Specimen(rng.normal(size=(5, 3)) * 1e-7, [rng.normal(size=(4, 3))], id="", scale=1 / 3),
            Specimen([[nan, nan], [0.1, -0.0]], notes={"COMMENT": "", "TWO WORDS": "a\nb"}),
        ]
        for name in ("again.tps", "again.tps.gz"):
            write_tps(tmp_path / name, specimens)
            assert_same(read_tps(tmp_path / name), specimens)
        assert gzip.open(tmp_path / "again.tps.gz").read() == (tmp_path / "again.tps").read_bytes()
        assert b"\nNA NA\n" in (tmp_path / "again.tps").read_bytes()

    @pytest.mark.parametrize(
        ("specimen", "message"),
        [
            (dict(id="a\nb"), "`id` must be one line without blanks at its ends, got 'a"),
            (dict(image=" a"), "`image` must be one line"),
            (dict(notes={"COMMENT": "a \nb"}), "`notes` must be one line"),
            (
                dict(notes={"ID": "a"}),
                "`notes` has the key 'ID': use upper case, and no key that has a meaning",
            ),
            (dict(notes={"comment": "a"}), "key 'comment'"),
            (dict(notes={"A=B": "a"}), "key 'A=B'"),
            (dict(notes={"": "a"}), "key ''"),
        ],
    )
    def test_refuses_what_would_not_read_back(self, tmp_path, specimen, message):
        with pytest.raises(ValueError, match=message):
            write_tps(tmp_path / "a.tps", [Specimen(np.zeros((1, 2)), **specimen)])
        assert not (tmp_path / "a.tps").exists()

    def test_nothing(self, tmp_path):
        with pytest.raises(ValueError, match="`specimens` must hold at least one specimen"):
            write_tps(tmp_path / "a.tps", [])


def test_specimen_checks_shapes():
    with pytest.raises(ValueError, match=r"`landmarks` must have the shape .* got \(4,\)"):
        Specimen(np.zeros(4))
    with pytest.raises(ValueError, match=r"`curves\[1\]` must have the shape \(n, 2\), got \(3, 3\)"):
        Specimen(np.zeros((1, 2)), [np.zeros((3, 2)), np.zeros((3, 3))])


class TestReadCsv:
    def test_wide(self, file):
        path = file("y1,id, x1 ,x2,y2,sex\r\n2,a,1,3,4,f\r\n\r\n6,,5,NA,,\r\n", "wide.csv")
        one, two = read_csv(path)
        assert (one.landmarks.tolist(), one.id, one.notes) == ([[1, 2], [3, 4]], "a", {"sex": "f"})
        np.testing.assert_array_equal(two.landmarks, [[5, 6], [np.nan, np.nan]])
        assert (two.id, two.notes) == (None, {"sex": ""})

    def test_wide_from_zero_in_space(self, file):
        (one,) = read_csv(file("\ufeffname;x0;y0;z0\n'b';1;2;3\n", "a.csv"), id="name", delimiter=";")
        assert one.landmarks.tolist() == [[1, 2, 3]] and one.id == "'b'"

    def test_long(self, file):
        content = "id,point,x,y,side,group\nb,1,1,2,l,p\na,2,7,8,r,q\nb,2,3,4,r,p\na,1,5,6,l,q\n"
        b, a = read_csv(file(content, "long.csv"))
        assert (b.id, b.landmarks.tolist(), b.notes) == ("b", [[1, 2], [3, 4]], {"group": "p"})
        assert (a.id, a.landmarks.tolist(), a.notes) == ("a", [[5, 6], [7, 8]], {"group": "q"})

    def test_long_without_id_and_number(self, file):
        (one,) = read_csv(file("z,x,y\n3,1,2\n6,4,5\n", "long.csv"))
        assert one.landmarks.tolist() == [[1, 2, 3], [4, 5, 6]] and one.id is None

    def test_quoted_cells_may_hold_line_breaks(self, file):
        one, _ = read_csv(file('id,note,x1,y1\n"a,b","two\nlines",1,2\nc,,1,2\n', "a.csv"))
        assert (one.id, one.notes) == ("a,b", {"note": "two\nlines"})

    @pytest.mark.parametrize(
        ("content", "line", "message"),
        [
            ("", 1, "expected a header such as id,x1,y1,x2,y2, found nothing"),
            ("id,x1,y1\n", 2, "expected at least one row, found the end of the file"),
            ("id;x1;y1\na;1;2\n", 1, "expected columns x1, y1, ... or x, y, found 'id;x1;y1'. .*`delimiter`"),
            ("id,x1,x1,y1\na,1,1,1\n", 1, "expected different names of columns, found 'x1' twice"),
            ("id,x1,y1\na,1\n", 2, "expected 3 cells as in the header, found 2. Quote"),
            ("id,x1,y1,x2\na,1,1,1\n", 1, "expected the column 'y2', found .* Every point from 1 to 2"),
            ("id,x1,y1,x3,y3\na,1,1,1,1\n", 1, "expected the column 'x2'"),
            ("id,x1,y1,z1,x2,y2\na,1,1,1,1,1\n", 1, "expected the column 'z2'"),
            ("id,x1,y1\na,1,2\nb,1,?\n", 3, "expected a finite number, found '\\?'"),
            ('id,x1,y1\n"a\nb",1,2\nc,1,-inf\n', 4, "found '-inf'"),
            (
                "id,point,x,y\na,1,0,0\na,3,0,0\n",
                3,
                "expected point 2 next, found point 3. Number the points",
            ),
            ("id,point,x,y\na,1,0,0\na,1,0,0\n", 3, "expected point 2 next, found point 1"),
            ("id,point,x,y\na,2,0,0\n", 2, "expected point 1 next, found point 2"),
            ("id,point,x,y\na,1.0,0,0\n", 2, "expected a whole number in 'point', found '1.0'"),
        ],
    )
    def test_errors_name_file_line_and_cure(self, file, content, line, message):
        with pytest.raises(ValueError, match=rf"(?s)table\.csv, line {line}: .*{message}"):
            read_csv(file(content, "table.csv"))


class TestWriteCsv:
    @pytest.mark.parametrize("layout", ["wide", "long"])
    @pytest.mark.parametrize("dim", [2, 3])
    @pytest.mark.parametrize("delimiter", [",", ";"])
    def test_round_trip(self, tmp_path, layout, dim, delimiter):
        rng = np.random.default_rng(2)
        shapes = rng.normal(size=(3, 4, dim)) / 3.0
        shapes[1, 2] = np.nan
        specimens = [
            Specimen(shape, id=name, notes={"sex": "f", "note": f'{name}, "so;\ncalled"'})
            for shape, name in zip(shapes, ["a", "b, c", "d"], strict=True)
        ]
        for name in ("a.csv", "a.csv.gz"):
            write_csv(tmp_path / name, specimens, layout=layout, delimiter=delimiter)
            assert_same(read_csv(tmp_path / name, delimiter=delimiter), specimens)

    def test_long_holds_different_numbers_of_points(self, tmp_path):
        specimens = [Specimen(np.ones((n, 2)), id=str(n)) for n in (1, 3)]
        write_csv(tmp_path / "a.csv", specimens, layout="long")
        assert_same(read_csv(tmp_path / "a.csv"), specimens)

    def test_errors(self, tmp_path):
        path, one, two = tmp_path / "a.csv", Specimen(np.ones((1, 2))), Specimen(np.ones((2, 2)))
        with pytest.raises(ValueError, match="`layout` must be one of 'wide', 'long'; got 'tall'"):
            write_csv(path, [one], layout="tall")
        with pytest.raises(ValueError, match="at least one specimen"):
            write_csv(path, [])
        with pytest.raises(ValueError, match=r"`specimens\[0\]` has curves, an image or a scale.*`write_tps`"):
            write_csv(path, [Specimen(np.ones((1, 2)), scale=1.0)])
        with pytest.raises(
            ValueError, match=r"`specimens\[1\]` has landmarks of shape \(2, 2\), the first of \(1, 2\)"
        ):
            write_csv(path, [one, two])
        with pytest.raises(ValueError, match=r"of shape \(0, 2\)"):
            write_csv(path, [Specimen(np.ones((0, 2)))], layout="long")
        with pytest.raises(ValueError, match=r"`specimens\[1\]` has the notes \['A'\], the first \[\]"):
            write_csv(path, [one, Specimen(np.ones((1, 2)), notes={"A": "a"})])
        with pytest.raises(ValueError, match="different ids in a long table"):
            write_csv(path, [one, two], layout="long")


class TestRealFiles:
    def test_papilio_curves_are_the_raw_outlines(self, shared_data):
        folder = shared_data / "papilio"
        specimens = read_tps(folder / "papilio_raw_10.tps")
        with np.load(folder / "papilio.npz") as data:
            raw = dict(zip(data["specimen"], data["raw"], strict=True))
        assert len(specimens) == 10
        for specimen in specimens:
            outline = np.concatenate(specimen.curves)
            np.testing.assert_allclose(outline, raw[specimen.id], atol=0.051)  # the file has one decimal
            np.testing.assert_array_equal(specimen.landmarks, outline[[0, 250, 499, 500, 749, 999]])
            assert specimen.image.startswith(specimen.id)

    def test_papilio_aligned_agrees_with_its_table(self, shared_data):
        folder = shared_data / "papilio"
        tps = read_tps(folder / "papilio_aligned_100.tps")
        table = read_csv(folder / "landmarks_aligned.csv.gz", id="index")
        for one, two in zip(tps, table, strict=True):
            np.testing.assert_allclose(one.landmarks, two.landmarks[::10], atol=6e-9)

    def test_papilio_outlines(self, shared_data):
        folder = shared_data / "papilio"
        for specimen, name in zip(read_tps(folder / "outlines.tps"), ["polytes", "honrathi"], strict=True):
            rows = np.genfromtxt(folder / f"outline_{name}_anchored.csv", delimiter=",", names=True)
            pixels = np.stack([rows["x_px"], rows["y_px"]], axis=1)
            assert specimen.landmarks.shape == (4, 2) and specimen.curves[0].shape == (500, 2)
            near = [np.abs(pixels - point).max(axis=1).min() for point in specimen.landmarks]
            assert max(near) < 2e-3

    def test_tyrannus_agrees_with_its_table(self, shared_data):
        tps = read_tps(shared_data / "tyrannus" / "tyrannus.tps")
        table = read_csv(shared_data / "tyrannus" / "landmarks.csv", id="index")
        assert len(tps) == 281
        for i, (one, two) in enumerate(zip(tps, table, strict=True)):
            np.testing.assert_allclose(one.landmarks, two.landmarks, atol=6e-9)
            assert one.id == f"{two.notes['tip']}_{i:03d}" and two.id == str(i)

    def test_rats_agree_with_their_table(self, shared_data):
        tps = read_tps(shared_data / "rats" / "rats.tps")
        table = read_csv(shared_data / "rats" / "rats.csv")
        assert len(tps) == 164
        for one, two in zip(tps, table, strict=True):
            np.testing.assert_array_equal(one.landmarks, two.landmarks)
            assert one.id == f"rat{int(two.notes['rat']):02d}_day{int(two.notes['age_days']):03d}"
