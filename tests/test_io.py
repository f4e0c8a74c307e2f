"""Reading and writing of files of shapes, sets of specimens, and what is said of broken files."""

import gzip
import json
import re

import numpy as np
import pandas as pd
import pytest

from numpyro_bridges.io import (
    Specimen,
    join,
    read,
    read_csv,
    read_morphologika,
    read_nts,
    read_slicer,
    read_tps,
    stack,
    write_csv,
    write_tps,
)

NAN = np.nan


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
        assert two.landmarks.shape == (0, 2) and (two.id, two.image, two.scale) == (
            "second",
            None,
            None,
        )

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
        assert one.landmarks.tolist() == [[1, 2, 3], [4, 5, 6]] and one.curves[0].tolist() == [
            [7, 8, 9]
        ]

    def test_missing_values(self, file):
        path = file("LM=4\nNA NA\n-1 5\nnan 3\n0 0\nCURVES=1\nPOINTS=1\n-2 -2\n")
        (plain,) = read_tps(path)
        nan = np.nan
        np.testing.assert_array_equal(plain.landmarks, [[nan, nan], [-1, 5], [nan, 3], [0, 0]])
        (digitised,) = read_tps(path, negative_is_missing=True)
        np.testing.assert_array_equal(
            digitised.landmarks, [[nan, nan], [nan, nan], [nan, 3], [0, 0]]
        )
        assert digitised.curves[0].tolist() == [[-2, -2]]

    def test_outlines_are_curves(self, file):
        content = "LM=1\n9 9\nOUTLINES=1\nPOINTS=3\n0 0\n4 0\n4 2\nCURVES=1\nPOINTS=1\n1 1\nID=a\n"
        (one,) = read_tps(file(content))
        assert [curve.tolist() for curve in one.curves] == [[[1, 1]], [[0, 0], [4, 0], [4, 2]]]
        assert one.landmarks.tolist() == [[9, 9]] and one.id == "a" and one.notes == {}

    @pytest.mark.parametrize("scale", ["", "NA", "NaN", " na "])
    def test_no_scale(self, file, scale):
        (one,) = read_tps(file(f"LM=1\n1 2\nSCALE={scale}\nID=a\n"))
        assert one.scale is None and one.id == "a"

    def test_lines_before_the_first_specimen(self, file):
        again = "LM=1\n1 2\n# the tip\nID=a\n# the next\nLM=0\n#TAG=b\n"
        assert [one.notes for one in read_tps(file(again))] == [{}, {"#TAG": "b"}]
        comment = "# made by hand\n\nMetadata separator: __\nunit = mm\n"
        (one,) = read_tps(file(comment + "lm=1\n1 2\nID=a\n"))
        assert one.landmarks.tolist() == [[1, 2]] and one.id == "a"

    def test_tells_of_what_looks_like_a_mark(self, file):
        path = file("LM=3\n812 420\n-1.00 -1.00\n640 455\nID=a\n")
        with pytest.warns(
            UserWarning, match=r"point 2 of `specimens\[0\]` \('a'\) is -1 .*`negative_is"
        ):
            (one,) = read_tps(path)
        assert one.landmarks[1].tolist() == [-1, -1]
        (one,) = read_tps(path, negative_is_missing=True)
        np.testing.assert_array_equal(one.landmarks, [[812, 420], [NAN, NAN], [640, 455]])
        for points in ("-1 -1\n-2 3\n4 5\n", "-1 -2\n3 3\n4 5\n", "-1 -1\n-1 -1\n-1 -1\n"):
            read_tps(file("LM=3\n" + points))  # centred, not the same, nothing else: not a word

    def test_encoding(self, file):
        path = file("LM=1\n0 0\nID=Käfer\n".encode("cp1252"))
        with pytest.raises(
            ValueError, match=r"shapes.tps: expected text .*'utf-8', found byte 0xe4. Pass its"
        ):
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
            (
                "LM=1\n1 1 1\n",
                2,
                "expected 2 numbers for point 1 of 1, found '1 1 1'. .*LM3= for three",
            ),
            ("LM3=1\n1 1\n", 2, "expected 3 numbers"),
            (
                "LM=1\n1,5 2,5\n",
                2,
                "expected a finite number, found '1,5'. Write decimals with a point",
            ),
            ("LM=1\n1 x\n", 2, "found 'x'"),
            ("LM=1\n1 inf\n", 2, "found 'inf'"),
            ("LM=1\n1 1_0\n", 2, "found '1_0'"),
            ("LM=0\nSCALE=1 mm\n", 2, "expected a finite number, found '1 mm'"),
            ("LM=0\nSCALE=0\n", 2, "expected a positive number after SCALE=, found 'SCALE=0'"),
            ("ID=a\nLM=0\n", 1, "found 'ID=a'. .*delete what stands before the first one"),
            ("1 2\nLM=0\n", 1, "found '1 2'"),
            (
                "LM=0\nOUTLINES=2\nPOINTS=1\n1 1\n",
                5,
                "POINTS= of curve 2 of 2, .*correct OUTLINES=",
            ),
            (
                "LM=0\nID=a\n\nID=b\n",
                4,
                "expected ID= once for the specimen from line 1, found 'ID=b'",
            ),
            ("LM=0\nCURVES=0\nCURVES=0\n", 3, "expected CURVES= once"),
            ("LM=0\nPOINTS=1\n1 1\n", 2, "expected CURVES= before POINTS="),
            (
                "LM=0\nCURVES=1\nPOINTS=1\n1 1\nPOINTS=1\n2 2\n",
                5,
                "CURVES= gives the number of POINTS=",
            ),
            (
                "LM=0\nCURVES=2\nPOINTS=1\n1 1\nLM=0\n",
                5,
                "expected POINTS= of curve 2 of 2, found 'LM=0'",
            ),
            (
                "LM=0\nCURVES=1\nPOINTS=2\n1 1\nID=a\n",
                5,
                "point 2 of 2, found 'ID=a'. The block POINTS=2",
            ),
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
    with pytest.raises(
        ValueError, match=r"`curves\[1\]` must have the shape \(n, 2\), got \(3, 3\)"
    ):
        Specimen(np.zeros((1, 2)), [np.zeros((3, 2)), np.zeros((3, 3))])


class TestReadCsv:
    def test_wide(self, file):
        path = file("y1,id, x1 ,x2,y2,sex\r\n2,a,1,3,4,f\r\n\r\n6,,5,NA,,\r\n", "wide.csv")
        one, two = read_csv(path)
        assert (one.landmarks.tolist(), one.id, one.notes) == ([[1, 2], [3, 4]], "a", {"sex": "f"})
        np.testing.assert_array_equal(two.landmarks, [[5, 6], [np.nan, np.nan]])
        assert (two.id, two.notes) == (None, {"sex": ""})

    def test_wide_from_zero_in_space(self, file):
        (one,) = read_csv(
            file("\ufeffname;x0;y0;z0\n'b';1;2;3\n", "a.csv"), id="name", delimiter=";"
        )
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
            (
                "id:x1:y1\na:1:2\n",
                1,
                "expected columns x1, y1, ... or x, y, found 'id:x1:y1'. .*`delimiter`",
            ),
            ("a,1,2\nb,3,4\n", 1, "found 'a', '1', '2'. Is there no header"),
            ("1 2 3\n4 5 6\n", 1, "a header with .*, found no header, numbers only"),
            ("id,x1,X01,y1\na,1,1,1\n", 1, "one column for a coordinate, found 'x1' and 'X01'"),
            ("id,x,X,y\na,1,1,1\n", 1, "one column x, found 'x' and 'X'"),
            ("x,y,x.1,y.1\n1,1,1,1\n", 1, "one set of coordinates, found those of 'x' and 'x.1'"),
            (
                "LM1_x,LM1_y,SL1_x,SL1_y\n1,1,1,1\n",
                1,
                "one set of coordinates, .* 'LM1_x' and 'SL1_x'",
            ),
            ("RawCoord1,RawCoord2,RawCoord4\n1,1,1\n", 1, "expected the column '3'"),
            (
                "RawCoord1,RawCoord2,RawCoord3,RawCoord4,RawCoord5\n1,1,1,1,1\n",
                1,
                "multiple of 2 .*`dim`",
            ),
            (
                "specimen,lm,x,y\na,1,0,0\na,2,0,1\n",
                1,
                "no column id, but 'specimen'. Pass `id='specimen'`",
            ),
            ("id,x,y\na,0,0\n,1,1\n", 3, "expected a name in 'id', found none"),
            (
                "id,lm,x,y\na,1,0,0\na,2,1,1\nb,2,0,0\nb,1,1,1\n",
                4,
                "one order of points in 'lm', .*`point='lm'`",
            ),
            (
                "id,lm,x,y\na,p,0,0\na,q,1,1\na,r,1,1\nb,p,0,0\nb,r,1,1\n",
                5,
                "in 'lm', found p, q, r for 'a' and p, r",
            ),
            ("id,,x1,y1\na,7,1,2\n", 2, "nothing in column 2, which has no name, found '7'"),
            ("id;x1;y1\na;1,5;2.5\n", 2, "found '1,5'. Pass the `decimal` sign"),
            ("id\tx1\ty1\na\t1,200\t900\n", 2, "found '1,200'. Pass the `decimal`"),
            ('id,x1,y1\n"a,1,2\n', 2, "3 cells as in the header, found 1"),
            ("id,x1,x1,y1\na,1,1,1\n", 1, "expected different names of columns, found 'x1' twice"),
            ("id,x1,y1\na,1\n", 2, "expected 3 cells as in the header, found 2. Quote"),
            (
                "id,x1,y1,x2\na,1,1,1\n",
                1,
                "expected the column 'y2', found .* Every point from 1 to 2",
            ),
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


TRIANGLE = [[1.0, 2.0], [3.5, -4.0], [5.0, 6.25]]
SQUARE = [[0.5, 0.0], [10.0, 11.0], [-2.5, 7.0]]

ROWS = "\na,1,2,3.5,-4,5,6.25\nb,.5,0,10,11,-2.5,7\n"
EUROPEAN = ROWS.replace(",", ";").replace(".", ",")

WIDE = {
    "upper": "id,X1,Y1,X2,Y2,X3,Y3" + ROWS,
    "zeros": "ID,x01,x02,x03,y01,y02,y03\na,1,3.5,5,2,-4,6.25\nb,.5,10,-2.5,0,11,7\n",
    "number-first": "Id,1_x,1_y,2_x,2_y,3_x,3_y" + ROWS,
    "geomorph": '"","1.X","1.Y","2.X","2.Y","3.X","3.Y"' + ROWS,
    "r-blanks": ('"X1.X","X1.Y","X2.X","X2.Y","X3.X","X3.Y"' + ROWS).replace(",", " "),
    "prefix": ("id,LM1x,LM1y,LM2x,LM2y,LM3x,LM3y" + ROWS).replace(",", "\t"),
    "names": "id,tip_x,tip_y,hinge_x,hinge_y,end_x,end_y" + ROWS,
    "units": ("id,X 1 (mm),Y 1 (mm),X 2 (mm),Y 2 (mm),X 3 (mm),Y 3 (mm)" + ROWS).replace(",", "|"),
    "decimal-comma": "id;x1;y1;x2;y2;x3;y3" + EUROPEAN,
    "quoted-comma": 'id,x1,y1,x2,y2,x3,y3\na,1,2,"3,5",-4,5,"6,25"\nb,"0,5",0,10,11,"-2,5",7\n',
    "spreadsheet": "sep=;\nid;x1;y1;x2;y2;x3;y3;;" + EUROPEAN.replace("\n", ";;\n") + ";;;;;;;;\n",
    "comments": "# of a camera\n# in mm\nid,x1,y1,x2,y2,x3,y3" + ROWS,
    "row-numbers": ",id,x1,y1,x2,y2,x3,y3" + ROWS.replace("a,", "0,a,").replace("b,", "1,b,"),
}
LONG = {
    "upper": "ID,X,Y\na,1,2\na,3.5,-4\na,5,6.25\nb,.5,0\nb,10,11\nb,-2.5,7\n",
    "comma": "id;x;y\na;1;2\na;3,5;-4\na;5;6,25\nb;0,5;0\nb;10;11\nb;-2,5;7\n",
    "numbered": (
        "id\tPoint\tX (px)\tY (px)\na\t3\t5\t6.25\nb\t1\t.5\t0\na\t1\t1\t2\na\t2\t3.5\t-4\n"
        "b\t3\t-2.5\t7\nb\t2\t10\t11\n"
    ),
    "counted": "id,row,x,y\na,1,1,2\na,2,3.5,-4\na,3,5,6.25\nb,4,.5,0\nb,5,10,11\nb,6,-2.5,7\n",
    "labels": "id,lm,x,y\na,p,1,2\na,q,3.5,-4\na,r,5,6.25\nb,p,.5,0\nb,q,10,11\nb,r,-2.5,7\n",
}


class TestHeaders:
    """Tables as programs and people write them, all of the same two shapes."""

    @pytest.mark.parametrize(
        "content", [*WIDE.values(), *LONG.values()], ids=[*WIDE, *[f"long-{n}" for n in LONG]]
    )
    @pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
    def test_point_by_point(self, file, content, encoding):
        a, b = read_csv(file(content.encode(encoding), "table.csv"))
        assert (a.id, b.id) == ("a", "b") and a.notes == b.notes == {}
        np.testing.assert_array_equal(a.landmarks, TRIANGLE)
        np.testing.assert_array_equal(b.landmarks, SQUARE)

    def test_image_j(self, file):
        """Row numbers without a name, and specimens by a name of their own."""
        path = file(
            " ,Label,X,Y\n1,a.jpg,1,2\n2,a.jpg,3,4\n1,b.jpg,5,6\n2,b.jpg,7,8\n", "results.csv"
        )
        with pytest.raises(ValueError, match="no column id, but 'Label'"):
            read_csv(path)
        a, b = read_csv(path, id="label")
        assert (a.id, a.landmarks.tolist()) == ("a.jpg", [[1, 2], [3, 4]])
        assert (b.id, b.landmarks.tolist()) == ("b.jpg", [[5, 6], [7, 8]])
        (one,) = read_csv(path, id=None)
        assert one.id is None and one.landmarks.shape == (4, 2)
        with pytest.raises(
            ValueError, match="expected a column 'image', found '', 'Label', 'X', 'Y'"
        ):
            read_csv(path, id="image")
        with pytest.raises(ValueError, match="expected a column 'number'"):
            read_csv(path, id="Label", point="number")

    def test_points_without_a_header(self, file):
        for content in (
            "1804\t1268\n1845\t1268\n",
            "1804 1268\n1845 1268\n",
            "1804,0;1268\n1845;1268,0\n",
        ):
            (one,) = read_csv(file(content, "wing 3.txt"))
            assert (one.id, one.landmarks.tolist()) == ("wing 3", [[1804, 1268], [1845, 1268]])

    def test_header_in_a_comment(self, file, tmp_path):
        for delimiter in (" ", ",", ";"):
            header = delimiter.join("xyz")
            np.savetxt(
                tmp_path / "a.txt", [[1, 2, 3], [4, 5, 6]], delimiter=delimiter, header=header
            )
            (one,) = read_csv(tmp_path / "a.txt")
            assert one.landmarks.tolist() == [[1, 2, 3], [4, 5, 6]] and one.id is None
        (one,) = read_csv(file("# two words\n1 2\n3 4\n", "b.txt"))
        assert one.landmarks.tolist() == [[1, 2], [3, 4]] and one.id == "b"
        with pytest.raises(ValueError, match="line 3: expected 2 cells as in the header, found 3"):
            read_csv(file("# x y\n1 2\n3 4 5\n", "b.txt"))

    def test_coordinates_that_are_numbered_through(self, file):
        content = (
            "ID\t" + "\t".join(f"RawCoord{i}" for i in range(1, 7)) + "\na\t1\t2\t3\t4\t5\t6\n"
        )
        with pytest.warns(
            UserWarning,
            match="'RawCoord1' to 'RawCoord6' are read as 3 points in the plane. .*`dim=3`",
        ):
            (plane,) = read_csv(file(content, "m.txt"))
        assert plane.landmarks.tolist() == [[1, 2], [3, 4], [5, 6]] and plane.id == "a"
        assert read_csv(file(content, "m.txt"), dim=2)[0].landmarks.shape == (3, 2)
        assert read_csv(file(content, "m.txt"), dim=3)[0].landmarks.tolist() == [
            [1, 2, 3],
            [4, 5, 6],
        ]
        (one,) = read_csv(file("Coord1,Coord2,Coord3\n1,2,3\n", "m.txt"))
        assert one.landmarks.tolist() == [[1, 2, 3]]

    def test_codes_for_missing_values(self, file):
        content = "id,x1,y1,x2,y2\na,-999,-999.0,3,4\nb,n/a,,NULL,-\n"
        a, b = read_csv(file(content, "a.csv"), missing=[-999, "-"])
        np.testing.assert_array_equal(a.landmarks, [[NAN, NAN], [3, 4]])
        assert np.isnan(b.landmarks).all()
        read_csv(file("x1,y1\n9999,9999\n1,2\n", "a.csv"), missing="9999")
        for code in (None, True, [b"x"], [1j], np.inf):
            with pytest.raises(ValueError, match="`missing` must be"):
                read_csv(file("x1,y1\n1,2\n", "a.csv"), missing=code)
        for content, code in (("-99,-99,3,4", "-99"), ("9999,9999,-3,4", "9999")):
            with pytest.warns(
                UserWarning, match=f"point 1 of `specimens.0.` is {code} .*`missing`"
            ):
                read_csv(file(f"x1,y1,x2,y2\n{content}\n", "a.csv"))

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (
                "id,x1,y1\na,1,2\n".encode("utf-16-le"),
                "'utf-8', found bytes of zero. .*'utf-16-le'",
            ),
            ("id,x1,y1\na,1,2\n".encode("utf-16-be"), "found bytes of zero. .*'utf-16-be'"),
            (
                "id,x1,y1\na,1,2\n".encode("utf-16")[:-1],
                "'utf-16', found byte .* byte order mark says",
            ),
            (b"PK\x03\x04...", "found a workbook of a spreadsheet program. Save it as CSV"),
            (gzip.compress(b"x1,y1\n1,2\n", mtime=0)[:-9], "found a damaged one"),
        ],
    )
    def test_what_is_no_text(self, file, content, message):
        with pytest.raises(ValueError, match=rf"table\.csv: expected .*{message}"):
            read_csv(file(content, "table.csv"))


class TestSlicer:
    POINTS = [
        {"id": "1", "label": "nose", "position": [1.5, 2.5, 3.5], "positionStatus": "defined"},
        {"id": "2", "label": "ear", "position": [0, 0, 0], "positionStatus": "undefined"},
        {"id": "3", "label": "eye", "position": [4, 5, 6]},
    ]

    def markups(self, *lists):
        return json.dumps(
            {"markups": [{"coordinateSystem": "LPS", **each} for each in lists]}, indent=1
        )

    def test_json(self, file):
        points = {"type": "Fiducial", "controlPoints": self.POINTS}
        curve = {"type": "ClosedCurve", "controlPoints": self.POINTS[::2]}
        (one,) = read_slicer(file(self.markups(points, curve), "skull 7.mrk.json"))
        np.testing.assert_array_equal(one.landmarks, [[1.5, 2.5, 3.5], [NAN] * 3, [4, 5, 6]])
        assert [c.tolist() for c in one.curves] == [[[1.5, 2.5, 3.5], [4, 5, 6]]]
        assert one.id == "skull 7" and one.notes == {
            "coordinate system": "LPS",
            "labels": "nose\near\neye",
        }
        (one,) = read_slicer(file(self.markups(curve), "a.json"))
        assert one.landmarks.shape == (0, 3) and one.curves[0].shape == (2, 3)

    def test_fcsv(self, file):
        head = "# Markups fiducial file version = 4.11\n# CoordinateSystem = {}\n"
        columns = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
        rows = 'a,1.5,-2,3,0,0,0,1,1,1,0,"nose, tip",,{}\r\nb,0,0,0,0,0,0,1,1,1,0,ear,,{}\n'
        for system, name in (("LPS", "LPS"), ("0", "RAS"), ("1", "LPS")):
            content = head.format(system) + columns + rows.format("", "")
            (one,) = read_slicer(file(content, "skull.fcsv"))
            assert one.landmarks.tolist() == [[1.5, -2, 3], [0, 0, 0]] and one.id == "skull"
            assert one.notes == {"coordinate system": name, "labels": "nose, tip\near"}
        (one,) = read_slicer(
            file(head.format("LPS") + columns + rows.format(",2,0", ",0,0"), "a.fcsv")
        )
        np.testing.assert_array_equal(one.landmarks, [[1.5, -2, 3], [NAN] * 3])

    @pytest.mark.parametrize(
        ("content", "line", "message"),
        [
            ("{", 1, "JSON, found something else"),
            ('{\n "markups": [,]}', 2, "JSON, found something else"),
            ("{}", 1, "markups with their type"),
            ('{"markups": []}', 1, "points and curves"),
            (
                '{"markups": [{"type": "Plane", "controlPoints": []}]}',
                1,
                r"found markups of the type \['Plane'\]",
            ),
            (
                json.dumps({"markups": [{"type": "Fiducial", "controlPoints": []}] * 2}),
                1,
                "one list of points, found 2",
            ),
            (
                '{"markups": [{"type": "Fiducial", "controlPoints": [{"position": [1, 2]}]}]}',
                1,
                r"three coordinates of control point 1, found \[1, 2\]",
            ),
            (
                '{"markups": [{"type": "Fiducial", "controlPoints": [{"positionStatus": "odd"}]}]}',
                1,
                "a positionStatus, .* found 'odd'",
            ),
            ("# columns = id,x,y\na,1,2\n", 1, "columns x, y, z"),
            ("# Markups\na,1,2\n", 2, "a point with x, y, z, found 'a,1,2'"),
            ("# Markups\na,1,2,?\n", 2, "a finite number, found '\\?'"),
            ("# Markups\n", 2, "at least one point"),
        ],
    )
    def test_errors(self, file, content, line, message):
        with pytest.raises(ValueError, match=rf"a\.fcsv, line {line}: expected .*{message}"):
            read_slicer(file(content, "a.fcsv"))


class TestNts:
    @pytest.mark.parametrize(
        "content",
        [
            '"wings\n1 2L 4 1 -999 DIM=2\na b\n1 2 -999 -999.0\n5 6 7 8\n',
            "'wings\n\n1 2L 4L 1 -999 dim = 2\na\nb\nx1 y1 x2 y2\n1 2\n-999 -999\n5 6 7 8\n",
            "1 2B 4 1 -999 DIM=2\na 1 2 -999 -999\nb 5 6 7 8\n",
            "1 2E 4 0 DIM=2\r\n1 2 NA NA a\r\n5 6 7 8 b\r\n",
        ],
        ids=["labels", "columns", "first", "last"],
    )
    def test_specimens_in_rows(self, file, content):
        a, b = read_nts(file(content, "wings.nts"))
        np.testing.assert_array_equal(a.landmarks, [[1, 2], [NAN, NAN]])
        assert (a.id, b.id, b.landmarks.tolist()) == ("a", "b", [[5, 6], [7, 8]])

    def test_points_in_rows(self, file):
        (one,) = read_nts(file("1 2L 3 0 DIM=3\nnose ear\n1 2 3\n4 5 6\n", "skull.dta"))
        assert (one.id, one.notes) == ("skull", {"labels": "nose\near"})
        assert one.landmarks.tolist() == [[1, 2, 3], [4, 5, 6]]
        (one,) = read_nts(file("1 3 2 0\n1 2\n3 4\n5 6\n", "wing.nts"))
        assert one.landmarks.shape == (3, 2) and one.notes == {}
        one, two = read_nts(file("1 2 4 0 DIM=2\n1 2 3 4\n5 6 7 8\n"))
        assert one.id is two.id is None

    @pytest.mark.parametrize(
        ("content", "line", "message"),
        [
            ('"only this\n', 1, "a line such as .* an empty file"),
            ("2 2 4 0 DIM=2\n", 1, "a line such as 1 10L 20 0 DIM=2, found '2 2 4 0 DIM=2'"),
            ("1 2 4 0\n1 2 3 4\n5 6 7 8\n", 1, "DIM=, which divides the columns"),
            ("1 2 4 0 DIM=3\n", 1, "DIM=, which divides"),
            ("1 1 4 0 DIM=2\n1 2 3\n", 3, "more numbers or labels, found the end of the file"),
            ("1 1 4 0 DIM=2\n1 2 3 4\n5\n", 3, "the end of the file, found '5'"),
            ("1 1 4 0 DIM=2\n1 2 3 x\n", 2, "a finite number, found 'x'"),
        ],
    )
    def test_errors(self, file, content, line, message):
        with pytest.raises(ValueError, match=rf"a\.nts, line {line}: expected {message}"):
            read_nts(file(content, "a.nts"))


MORPHOLOGIKA = """[Individuals]
2
[landmarks]
2
[dimensions]
2
[names]
one wing
two
[labels]
sex side
[labelvalues]
f l
m r
[groups]
north 1 south 1
[rawpoints]
'1
1 2
9999 9999

'2
5\t6
7 8
[wireframe]
1 2
"""


class TestMorphologika:
    def test_everything_at_once(self, file):
        one, two = read_morphologika(file(MORPHOLOGIKA, "wings.txt"), missing=9999)
        np.testing.assert_array_equal(one.landmarks, [[1, 2], [NAN, NAN]])
        assert two.landmarks.tolist() == [[5, 6], [7, 8]] and (one.id, two.id) == (
            "one wing",
            "two",
        )
        assert one.notes == {"sex": "f", "side": "l", "group": "north"}
        assert two.notes == {"sex": "m", "side": "r", "group": "south"}
        with pytest.warns(UserWarning, match=r"point 2 of `specimens\[0\]` \('one wing'\) is 9999"):
            read_morphologika(file(MORPHOLOGIKA, "wings.txt"))

    def test_the_least(self, file):
        (one,) = read_morphologika(
            file("[individuals]\n1\n[landmarks]\n1\n[dimensions]\n3\n[rawpoints]\n1 2 3\n")
        )
        assert one.landmarks.tolist() == [[1, 2, 3]] and one.id is None and one.notes == {}

    @pytest.mark.parametrize(
        ("change", "line", "message"),
        [
            (
                ("[Individuals]", "wings\n[Individuals]"),
                1,
                "a section such as .individuals., found 'wings'",
            ),
            (("[dimensions]\n2\n", ""), 25, "a section .dimensions., found none"),
            (("[dimensions]\n2\n", "[dimensions]\n4\n"), 6, "2 or 3 in .dimensions., found '4'"),
            (("[landmarks]\n2\n", "[landmarks]\n3\n"), 24, "6 lines in .rawpoints., found 4"),
            (
                ("[landmarks]\n2\n", "[landmarks]\nx\n"),
                4,
                "a positive whole number in .landmarks., found 'x'",
            ),
            (("two\n", ""), 8, "2 lines in .names., found 1"),
            (("m r", "m"), 14, "2 values of labels, found 'm'"),
            (("south 1", "south 2"), 16, ".groups. of 2 specimens in all, found 'north 1 south 2'"),
            (("7 8", "7 8 9"), 24, "2 coordinates, found '7 8 9'"),
            (("7 8", "7 x"), 24, "a finite number, found 'x'"),
            (("[wireframe]", "[names]"), 25, ".names. once, found it twice"),
        ],
    )
    def test_errors(self, file, change, line, message):
        content = MORPHOLOGIKA.replace(*change)
        with pytest.raises(ValueError, match=rf"a\.txt, line {line}: expected {message}"):
            read_morphologika(file(content, "a.txt"), missing=9999)


@pytest.mark.parametrize(
    ("content", "name", "settings"),
    [
        ("# of a camera\nLM=2\n1 2\n3 4\nID=a\n", "a.txt", {}),
        ("id;x1;y1;x2;y2\na;1;2;3;4\n", "a.csv", {}),
        ("specimen,x,y\na,1,2\na,3,4\n", "a.txt", {"id": "specimen"}),
        ("1 2\n3 4\n", "a.txt", {}),
        ("1 2 2 0\n1 2\n3 4\n", "a.nts", {}),
        ('"of a microscope\n1 1L 4 0 dim=2\na\n1 2 3 4\n', "b.txt", {}),
        (
            "[individuals]\n1\n[landmarks]\n2\n[dimensions]\n2\n[names]\na\n[rawpoints]\n1 2\n3 4",
            "b.txt",
            {},
        ),
        ("# Markups fiducial file version = 4.1\nF,1,2,0\nF,3,4,0\n", "a.fcsv", {}),
    ],
    ids="tps wide long bare nts-name nts-line morphologika fcsv".split(),
)
def test_read_tells_formats_apart(file, content, name, settings):
    (one,) = read(file(content, name), **settings)
    assert one.id == "a" and one.landmarks[:, :2].tolist() == [[1, 2], [3, 4]]
    (again,) = read(file(gzip.compress(content.encode()), f"{name}.gz"), **settings)
    assert_same([again], [one])


class TestStack:
    def test_names_and_points(self):
        curve = np.array([[5.0, 6.0]])
        specimens = [
            Specimen([[1, 2], [NAN, 4]], [curve], id="a"),
            Specimen(np.zeros((2, 2)), [curve + 1]),
        ]
        names, shapes = stack(specimens)
        assert names == ["a", None]
        np.testing.assert_array_equal(shapes[0], [[1, 2], [NAN, 4], [5, 6]])
        assert shapes.shape == (2, 3, 2) and shapes[1, 2].tolist() == [6, 7]
        assert stack(specimens, points="landmarks").shapes.shape == (2, 2, 2)
        assert stack(specimens, points="curves").shapes.tolist() == [[[5, 6]], [[6, 7]]]

    def test_says_which_specimens_differ(self):
        def made(n, dim=2, curves=(), id=None):
            return Specimen(np.ones((n, dim)), [np.ones((m, dim)) for m in curves], id=id)

        odd = [made(3), made(2, id="short"), made(3)]
        with pytest.raises(
            ValueError,
            match=r"2 of 3 have 3 landmarks.*`specimens\[1\]` \('short'\) has 2 landmarks",
        ):
            stack(odd)
        with pytest.raises(ValueError, match=r"`specimens\[0\]` has 3 landmarks in 3 dim"):
            stack([made(3, 3), made(3), made(3)])
        with pytest.raises(
            ValueError, match=r"`specimens\[2\]` has 1 landmarks and curves of 4, 6 points"
        ):
            stack([made(1, curves=(4, 5)), made(1, curves=(4, 5)), made(1, curves=(4, 6))])
        with pytest.raises(ValueError, match="and 3 more"):
            stack([*[made(3)] * 9, *[made(2)] * 8])
        with pytest.raises(
            ValueError, match="must have points to stack; got 3 landmarks in 2 dim.*'curves'"
        ):
            stack([made(3)], points="curves")
        with pytest.raises(
            ValueError, match="`points` must be one of 'all', 'landmarks', 'curves'; got 'some'"
        ):
            stack([made(3)], points="some")


class TestJoin:
    SPECIMENS = [
        Specimen(np.ones((1, 2)), id="a", image="1.jpg", notes={"side": "left"}),
        Specimen(np.ones((1, 2)), id="b", image="2.jpg", notes={"side": "right"}),
    ]

    def test_by_name(self, file):
        path = file("ID;species;note;\nb;Aus bus;;\nc;Aus cus;;\na;Aus aus;x;\n", "table.csv")
        a, b = join(self.SPECIMENS, path)
        assert a.notes == {"side": "left", "species": "Aus aus", "note": "x"} and a.id == "a"
        assert b.notes == {"side": "right", "species": "Aus bus", "note": ""} and b.image == "2.jpg"

    def test_by_another_name_of_pandas(self):
        table = pd.DataFrame(
            {"file": ["2.jpg", "1.jpg"], "age": [3.0, NAN], "n": [1, 2], "side": ["right", "left"]}
        )
        a, b = join(self.SPECIMENS, table, by="file", of="image")
        assert a.notes == {"side": "left", "age": "", "n": "2"}
        assert b.notes == {"side": "right", "age": "3", "n": "1"}
        (a,) = join([a], pd.DataFrame({"number": [2], "sex": ["f"]}), by="number", of="n")
        assert a.notes["sex"] == "f"

    def test_row_after_row(self, file):
        path = file("species\nAus aus\nAus bus\n", "table.csv")
        assert [s.notes["species"] for s in join(self.SPECIMENS, path, by=None)] == [
            "Aus aus",
            "Aus bus",
        ]
        with pytest.raises(
            ValueError, match="a row for each of 1 specimens with by=None; got 2. Pass `by`"
        ):
            join(self.SPECIMENS[:1], path, by=None)

    @pytest.mark.parametrize(
        ("content", "settings", "message"),
        [
            (
                "name,sex\na,f\n",
                {},
                "`by` must be a column of the `table`, one of 'name', 'sex'; got 'id'",
            ),
            (
                "id,sex\na,f\nB,m\n",
                {},
                "a row for each specimen; 'id' lacks 'b'. Correct the names",
            ),
            (
                "file,sex\n1.jpg,f\n22.jpg,m\n",
                {"by": "file", "of": "image"},
                r"lacks '2.jpg' \(there is '22.jpg'\)",
            ),
            ("id,sex\na,f\nb,m\nb,f\n", {}, "one row for a specimen; several have 'b' in 'id'"),
            (
                "id,side\na,left\nb,left\n",
                {},
                r"`specimens\[1\]` \('b'\) has notes .* other texts: side",
            ),
            (
                "id,sex\na,f\nb,m\n",
                {"of": "tag"},
                r"`specimens\[0\]` \('a'\) has no 'tag' to be found by",
            ),
            ("1,2\n3,4\n", {}, "line 1: expected a header such as id,species, found numbers only"),
        ],
    )
    def test_errors(self, file, content, settings, message):
        with pytest.raises(ValueError, match=message):
            join(self.SPECIMENS, file(content, "table.csv"), **settings)


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
        with pytest.raises(
            ValueError, match=r"`specimens\[0\]` has curves, an image or a scale.*`write_tps`"
        ):
            write_csv(path, [Specimen(np.ones((1, 2)), scale=1.0)])
        with pytest.raises(
            ValueError,
            match=r"`specimens\[1\]` has landmarks of shape \(2, 2\), the first of \(1, 2\)",
        ):
            write_csv(path, [one, two])
        with pytest.raises(ValueError, match=r"of shape \(0, 2\)"):
            write_csv(path, [Specimen(np.ones((0, 2)))], layout="long")
        with pytest.raises(
            ValueError, match=r"`specimens\[1\]` has the notes \['A'\], the first \[\]"
        ):
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
            np.testing.assert_allclose(
                outline, raw[specimen.id], atol=0.051
            )  # the file has one decimal
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
        for specimen, name in zip(
            read_tps(folder / "outlines.tps"), ["polytes", "honrathi"], strict=True
        ):
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

    def test_one_door_for_all(self, shared_data):
        for name, count, shape in (
            ("papilio/papilio_raw_10.tps", 10, (1006, 2)),
            ("papilio/outlines.tps", 2, (504, 2)),
            ("tyrannus/tyrannus.tps", 281, (9, 2)),
            ("tyrannus/species_means.csv", 13, (9, 2)),
            ("rats/rats.csv", 164, (8, 2)),
            ("morpho/hindwings.csv.gz", 911, (29, 2)),
        ):
            assert stack(read(shared_data / name)).shapes.shape == (count, *shape), name
        with pytest.raises(ValueError, match="no column id, but 'segment'"):
            read(shared_data / "papilio" / "mean.csv")
        (mean,) = read(shared_data / "papilio" / "mean.csv", id=None)
        assert mean.landmarks.shape == (1000, 2)
        with pytest.raises(
            ValueError, match="expected columns x1, y1, ... or x, y, found 'specimen'"
        ):
            read(shared_data / "ptychomya" / "coefficients.csv")  # of Fourier

    def test_second_tables(self, shared_data):
        """Species of Papilio; of the shells that come as arrays."""
        folder = shared_data / "papilio"
        wings = join(read(folder / "papilio_raw_10.tps"), folder / "specimens.csv", by="specimen")
        with np.load(folder / "papilio.npz") as data:
            tips = dict(zip(data["specimen"], data["tip"], strict=True))
        assert [wing.notes["tip"] for wing in wings] == [tips[wing.id] for wing in wings]

        with np.load(shared_data / "ptychomya" / "outlines.npz") as data:
            shells = [
                Specimen(np.zeros((0, 2)), [outline], id=str(name))
                for outline, name in zip(data["outlines"], data["specimen"], strict=True)
            ]
            ages = data["age_ma"]
        shells = join(shells, shared_data / "ptychomya" / "coefficients.csv", by="specimen")
        np.testing.assert_allclose([float(shell.notes["age_ma"]) for shell in shells], ages)
        assert stack(shells).shapes.shape == (137, 100, 2)

        with np.load(shared_data / "steinmanella" / "steinmanella.npz") as data:
            surfaces = [Specimen(shape, id=str(i)) for i, shape in enumerate(data["shapes"])]
            species = data["species"].tolist()
        surfaces = join(surfaces, shared_data / "steinmanella" / "surfaces.csv", by="index")
        assert [surface.notes["species"] for surface in surfaces] == species
