"""DBAT scripts and PhotoModeler exports that cannot be used: one message with file, line and culprit."""

import re
import shutil

import pytest

from baarda.errors import BaardaError, InputError
from baarda.formats import read, recognise


@pytest.fixture
def script(camcal, tmp_path):
    shutil.copytree(camcal.parent, tmp_path / "s")
    return tmp_path / "s" / "camcaldemo.xml"


def edit(path, old, new, count=1):
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, count), encoding="utf-8")


MARKS, CONTROL, IMAGES = "measurements/markpts.txt", "reference/camcal-fixed.txt", "images/images.txt"
FIRST = " 1,    2, 1429.1871, 1456.4278, 0.1"


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (MARKS, FIRST, " 1,    2, 1429.1871, nan, 0.1", r"markpts.txt, line 3: y is not finite"),
        (MARKS, FIRST, " 1,    2, 1429.1871, abc, 0.1", r"markpts.txt, line 3: y is not a number: 'abc'"),
        (MARKS, FIRST, " 1,    2, 1429.1871", r"markpts.txt, line 3: 3 fields where the format"),
        (MARKS, FIRST, " 77,    2, 1429.1871, 1456.4278, 0.1", r"line 3: image '77' is not in the list"),
        (MARKS, FIRST, FIRST + "\n" + FIRST, r"line 4: point '2' is measured twice in image '1' \(first in line 3\)"),
        (MARKS, FIRST, " 1,    2, 1429.1871, 1456.4278, 0", r"line 3: a standard deviation must be positive"),
        (MARKS, FIRST, " 1,    2, 1429.1871, 1456.4278, -0.1", r"line 3: a standard deviation must be positive"),
        (MARKS, FIRST, " , 2, 1429.1871, 1456.4278, 0.1", r"line 3: image id is missing"),
        (CONTROL, "1003,CP3,0,0,0", "1002,CP3,0,0,0", r"camcal-fixed.txt, line 6: point '1002' appears twice \(first in line 5\)"),
        (CONTROL, "1003,CP3,0,0,0", "1003,CP3,0,0,inf", r"camcal-fixed.txt, line 6: z is not finite"),
        (CONTROL, "1003,CP3,0,0,0", "1003,CP3,0,0", r"camcal-fixed.txt, line 6: 4 fields"),
        (IMAGES, " 1, data", " 2, data", r"images.txt, line 4: image '2' appears twice"),
        ("camcaldemo.xml", "<model>3</model>", "<model>7</model>", r"lens distortion model '7' is not known"),
        ("camcaldemo.xml", "<focal>7.5</focal>", "<focal>-7.5</focal>", r"principal distance must be positive"),
        ("camcaldemo.xml", "<focal>7.5</focal>", "<focal>x</focal>", r"<focal> is not a list of numbers"),
        ("camcaldemo.xml", 'format="im,id,x,y,sxy"', 'format="im,id,u,v,sxy"', r"column 'u'"),
        ("camcaldemo.xml", "reference/camcal-fixed.txt", "reference/gone.txt", r"gone.txt: no such file"),
        ("camcaldemo.xml", "</document>", "", r"camcaldemo.xml, line 1\d\d: not well-formed"),
        ("camcaldemo.xml", "<?xml version", "<!DOCTYPE a [<!ENTITY b 'c'>]><?xml version", r"entity declaration is not accepted"),
        ("camcaldemo.xml", "<skew>false</skew>", "<swirl>false</swirl>", r"<swirl>false</swirl> is not known"),
        ("camcaldemo.xml", 'base_dir="$HERE"', 'base_dir="$DBAT"', r"folder '\$DBAT' is not known"),
        ("camcaldemo.xml", "<nK>3</nK>", "<nK>x</nK>", r"""<nK> is not a whole number: 'x'"""),
        ("camcaldemo.xml", "<nK>3</nK>", "<nK>4</nK>", r"""<nK> must be 0, 1, 2, 3, not 4"""),
        ("camcaldemo.xml", "<nP>2</nP>", "<nP>1.5</nP>", r"""<nP> is not a whole number: '1.5'"""),
        ("camcaldemo.xml", "<nP>2</nP>", "<nP>1</nP>", r"""<nP> must be 0, 2, not 1"""),
        ("camcaldemo.xml", 'min_rays="2"', 'min_rays="two"', r"""min_rays is not a whole number: 'two'"""),
        ("camcaldemo.xml", 'min_rays="2"', 'min_rays="-1"', r"""min_rays must be between 0 and 1000, not -1"""),
        ("camcaldemo.xml", "<aspect>1</aspect>", "<aspect>1</aspect><skew>x</skew>", r"""<skew> is not a list of numbers"""),
        ("camcaldemo.xml", "<aspect>1</aspect>", "<aspect>1</aspect><K>1,2,3,4</K>", r"""<K> has more than 3 values"""),
        ("camcaldemo.xml", "<aspect>1</aspect>", "<aspect>1</aspect><P>1,2,3</P>", r"""<P> has more than 2 values"""),
        ("camcaldemo.xml", "<focal>7.5</focal>", "<focal>7_5</focal>", r"""<focal> is not a list of numbers"""),
        ("camcaldemo.xml", "<focal>7.5</focal>", "<focal>٧.5</focal>", r"""<focal> is not a list of numbers"""),
        ("camcaldemo.xml", "<all>default</all>", "<all>banana</all>", r"""'banana' is not known; known are default, loaded"""),
        ("camcaldemo.xml", "<all>default</all>", "<cc>default</cc>", r"""<cc> is not known; known are default, loaded"""),
        ("camcaldemo.xml", "</camera>", "</camera><camera/>", r"""<cameras> has 2 cameras"""),
        ("camcaldemo.xml", "<unit>mm</unit>", "<unit>px</unit>", r"""must be mm, not 'px'"""),
        ("camcaldemo.xml", ">spatial_resection<", ">magic<", r"""operation 'magic' is not known"""),
        (
            "camcaldemo.xml",
            "<operation>spatial_resection</operation>",
            "<operation><magic/></operation>",
            r"""operation <magic> is not known""",
        ),
        ("camcaldemo.xml", "<operation>spatial_resection</operation>", "<task/>", r"""element <task> of <operations> is not known"""),
        (
            "camcaldemo.xml",
            'format="im,id,x,y,sxy"',
            'format="im,id,x,y,ignored"',
            r"""column 'sxy' .or 'sx' and 'sy'. is missing in format='im,id,x,y,ignored'""",
        ),
        ("camcaldemo.xml", 'format="im,id,x,y,sxy"', 'format="im,id,x,x,sxy"', r"""column 'x' appears twice in format"""),
        ("camcaldemo.xml", 'format="im,id,x,y,sxy"', 'format="im,ignored,x,y,sxy"', r"""column 'id' is missing in format"""),
        ("camcaldemo.xml", 'format="id,label,x,y,z"', 'format="id,label,x,y,ignored"', r"""column 'z' is missing in format"""),
        ("camcaldemo.xml", 'format="id,path"', 'format="ignored,path"', r"""column 'id' is missing in format"""),
        ("camcaldemo.xml", 'format="id,path"', 'format="id,ignored"', r"""column 'path' is missing in format"""),
        (MARKS, FIRST, " 1,    2, 1_429.1871, 1456.4278, 0.1", r"line 3: x is not a number: '1_429.1871'"),
        (MARKS, FIRST, " 1,    2, \u0661429.1871, 1456.4278, 0.1", r"line 3: x is not a number"),
        (MARKS, FIRST, " 1,    2, 1429.1871, 1456.4278, 1e200", r"line 3: a standard deviation = 1e\+200 does not lie"),
        (MARKS, FIRST, " 1,    2\x07, 1429.1871, 1456.4278, 0.1", r"markpts.txt, line 3: the line holds a control character"),
        (MARKS, FIRST, " 1,    2\t3, 1429.1871, 1456.4278, 0.1", r"markpts.txt, line 3: point id '2.t3' holds a control character"),
        ("camcaldemo.xml", "<image_pts>", "<lidar/><image_pts>", r"element <lidar> of <input> is not known"),
    ],
)
def test_broken_script(script, file, old, new, words):
    edit(script.parent / file, old, new)
    with pytest.raises(InputError, match=words) as caught:
        read(script, format="dbat")
    assert caught.value.exit_code == 2


def test_empty_and_binary_tables(script):
    (script.parent / MARKS).write_bytes(b"")
    with pytest.raises(InputError, match=r"markpts.txt: the file is empty"):
        read(script)
    (script.parent / MARKS).write_bytes(b"# x\n1, 2, \xff\xfe\n")
    with pytest.raises(InputError, match=r"markpts.txt, line 2: the file is not UTF-8"):
        read(script)


def test_an_image_without_points_is_named_with_its_line(script):
    path = script.parent / IMAGES
    path.write_text(path.read_text() + "22, extra.jpg\n")
    with pytest.raises(InputError, match=r"images.txt, line 24: image '22' has no image points"):
        read(script)


def test_check_and_control_at_once(data, tmp_path):
    shutil.copytree(data("dbat_sxb"), tmp_path / "s")
    path = tmp_path / "s" / "sxb.xml"
    edit(path, '<filter id="351,410">remove</filter>', "")
    with pytest.raises(InputError, match="both control and check"):
        read(path)
    edit(path, '<filter id="351,410">keep', '<filter id="351,999">keep')
    with pytest.raises(InputError, match="the filter names points that the table does not have: 999"):
        read(path)


def test_truncated_exports(data, tmp_path):
    """An export cut after any line is read or refused with one message; it never ends in another error."""
    source = data("dbat_sxb") / "pm" / "w-op0-with-orient-pmexport.txt"
    lines = source.read_text().splitlines(keepends=True)
    refused = 0
    for n in range(0, len(lines), 7):
        path = tmp_path / "cut.txt"
        path.write_text("".join(lines[:n]))
        try:
            read(path, format="photomodeler")
        except BaardaError:
            refused += 1
    assert refused >= 5


@pytest.mark.parametrize(
    ("line", "text", "words"),
    [
        (2, " 0.000500 20\n", r"line 2: the image size in pixels is missing"),
        (4, "123.9392 26.5770 x 53 77 0 0 0 0 0\n", r"line 4: camera value is not a number: 'x'"),
        (7, "   0 -118.673  109.359 nan  -89.917   -0.420    0.784\n", r"line 7: exterior orientation is not finite"),
        (2, " 0.000500 20 0 12996\n", r"line 2: the image size in pixels must be positive"),
        (4, "0 26.5770 38.8 53 77 0 0 0 0 0\n", r"line 4: the principal distance must be positive"),
        (4, "123 26.5770 38.8 53 -77 0 0 0 0 0\n", r"line 4: the format size must be positive"),
        (4, "1_23 26.5770 38.8 53 77 0 0 0 0 0\n", r"line 4: camera value is not a number"),
        (12, "   0 again.jpg\n", r"line 12: photo '0' appears twice \(first in line 6\)"),
        (117, "   4   14  1.0 2.0 1e200 1.0\n   4   14  1.0 2.0 1.0 1.0\n", r"line 117: a standard deviation of a mark = 1e\+200"),
        (117, "   4   14  1.0 2.0 1.0 1.0\n   4   14  1.0 2.0 1.0 1.0\n", r"measured twice in photo '4' \(first in line 1\d\d\)"),
        (40, "     351  771.7 14.7\n", r"line 40: 3 fields where 7"),
    ],
)
def test_broken_export(data, tmp_path, line, text, words):
    source = data("dbat_sxb") / "pm" / "w-op0-with-orient-pmexport.txt"
    lines = source.read_text().splitlines(keepends=True)
    lines[line - 1] = text
    path = tmp_path / "broken.txt"
    path.write_text("".join(lines))
    with pytest.raises(InputError, match=words):
        read(path, format="photomodeler")


def test_recognised_by_content(data, camcal, tmp_path):
    assert recognise(camcal).name == "dbat"
    assert recognise(data("dbat_sxb") / "pm" / "w-op0-with-orient-pmexport.txt").name == "photomodeler"
    assert recognise(data("colmap_sceaux_txt")).name == "colmap"
    copy = tmp_path / "other.name"
    shutil.copy(camcal, copy)
    assert recognise(copy).name == "dbat"


def test_an_export_cut_within_its_marks_is_refused(data, tmp_path):
    raw = (data("dbat_sxb") / "pm" / "w-op0-with-orient-pmexport.txt").read_bytes()
    path = tmp_path / "cut.txt"
    lines = raw.splitlines(keepends=True)
    assert not lines[117].strip() and len(lines[116].split()) == 6
    marks = len(b"".join(lines[:117]))
    for end in [*range(marks - 400, marks, 3), marks]:
        path.write_bytes(raw[:end])
        with pytest.raises(InputError, match=r"cut.txt, line 1\d\d: (the blank line that ends this section is missing|\d fields)"):
            read(path, format="photomodeler")


@pytest.mark.parametrize("folder", ["dbat_camcal", "dbat_sxb"])
def test_all_exports_at_hand_are_read(data, folder):
    for path in sorted((data(folder) / "pm").glob("*.txt")):
        assert len(read(path, format="photomodeler").observations[0]) > 40


def test_labels_of_any_script(script):
    for file in (MARKS, IMAGES):
        path = script.parent / file
        path.write_text(re.sub(r"(?m)^ *1,", "\u0418\u0437\u2028\u5716 1,", path.read_text()), encoding="utf-8")
    assert "\u0418\u0437\u2028\u5716 1" in read(script).images.labels
