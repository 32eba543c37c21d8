"""Whole files of every reader, from which the damaged ones are made: real ones where the repository or the shared data hold them.

A seed is a small folder. A maker is a generator named after the format: it is given an empty folder, puts files into sub-folders of it,
and yields the path that is read.
"""

from __future__ import annotations

import base64
import bz2
import gzip
import io
import json
import re
import shutil
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import test_camera_positions
import test_format_aicon
import test_format_colmap
import test_format_control
import test_format_metashape
import test_format_mrcal
import test_format_nvm
import test_format_openmvg
import test_format_opensfm
import test_format_opf
import test_format_patb_bingo
import test_format_pix4d
import test_format_project
from baarda.formats import formats, read, write
from baarda.network import CHECK, Network
from conftest import HERE, SHARED
from fuzzing.mutations import BLOB, packed
from networks import ring, with_distances
from reference import test_bundler, test_libmv

_RANDOM = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[0-9a-f]{4}-[0-9a-f]{12}")
Maker = Callable[[Path], Iterator[Path]]


@dataclass(frozen=True)
class Seed:
    """Files by name, the path that is read (``.`` = the folder), and what reads it.

    Attributes
    ----------
    reader : str
        Name of a format, or one of `TABLES`.
    label : str
    files : dict of str to bytes
    entry : str
    """

    reader: str
    label: str
    files: dict[str, bytes]
    entry: str

    @property
    def size(self) -> int:
        """Return the number of bytes of all files."""
        return sum(map(len, self.files.values()))


def _shared(name: str) -> Path | None:
    return next((p for p in (HERE / "data" / name, SHARED / name) if p.exists()), None)


def _copies(folder: Path, *names: str) -> Iterator[Path]:
    """Copy files of the test data, each into a folder of its own."""
    for name in names:
        source = _shared(name)
        if source is not None:
            place = folder / name.replace("/", "-")
            place.mkdir()
            yield Path(shutil.copy(source, place))


def bal(folder: Path) -> Iterator[Path]:
    for i, path in enumerate(_copies(folder, *(f"bal_dubrovnik_tiny/dubrovnik-3-7{s}-pre.txt" for s in ("", "-18")))):
        yield path
        for module, end in ((bz2, "bz2"), (gzip, "gz")):
            small = folder / f"{end}{i}" / f"problem.txt.{end}"
            small.parent.mkdir()
            small.write_bytes(bz2.compress(path.read_bytes()) if module is bz2 else gzip.compress(path.read_bytes(), mtime=0))
            yield small


def bundler(folder: Path) -> Iterator[Path]:
    source = _shared("bal_dubrovnik_tiny/dubrovnik-3-7-pre.txt")
    if source is not None:
        write(read(source), folder / "written", "bundler")
        yield folder / "written"
    (folder / "by hand").mkdir()
    yield test_bundler.write_small(folder / "by hand", names="a.jpg 0 1234.5\nb c.jpg\nd.jpg 0 9e2\n")


def colmap(folder: Path) -> Iterator[Path]:
    yield test_format_colmap.written(folder / "text")
    yield test_format_colmap.binary(folder / "binary")
    write(ring(images=4, points=12, model="OPENCV", values=_OPENCV, free=()), folder / "ring", "colmap")
    yield folder / "ring"
    source = _shared("colmap_sceaux_txt")
    if source is not None:
        yield _part_of_colmap(source, folder / "sceaux", 3)


_OPENCV = {
    "principal_distance_x": 900.0,
    "principal_distance_y": 905.0,
    "principal_point_x": 500.0,
    "principal_point_y": 400.0,
    "k1": -0.05,
    "k2": 0.01,
    "p1": 1e-4,
    "p2": -1e-4,
}


def _part_of_colmap(source: Path, target: Path, count: int) -> Path:
    """Copy a few images of a text model with 150 points that they share; the marks of an image are counted anew."""
    target.mkdir()
    head, rows = [], []
    for name, out in (("images.txt", head), ("points3D.txt", rows)):
        out += [line.split() for line in (source / name).read_text().splitlines() if not line.startswith("#")]
    seen = {h[0]: {w for w in marks[2::3] if w != "-1"} for h, marks in zip(head[::2], head[1::2], strict=True)}
    first = next(iter(seen.values()))
    kept = sorted(seen, key=lambda name: -len(seen[name] & first))[:count]
    marks: dict[str, list[str]] = {name: [] for name in kept}
    old = {h[0]: m for h, m in zip(head[::2], head[1::2], strict=True)}
    points = []
    for row in (r for r in rows if sum(r[0] in seen[name] for name in kept) > 1):
        track = []
        for image, k in zip(row[8::2], row[9::2], strict=True):
            if image in marks:
                track += [image, str(len(marks[image]) // 3)]
                marks[image] += old[image][3 * int(k) : 3 * int(k) + 3]
        points.append(" ".join([*row[:8], *track]))
        if len(points) == 150:
            break
    shutil.copy(source / "cameras.txt", target)
    lines = [text for h in head[::2] if h[0] in kept for text in (" ".join(h), " ".join(marks[h[0]]))]
    (target / "images.txt").write_text("\n".join(lines) + "\n")
    (target / "points3D.txt").write_text("\n".join(points) + "\n")
    return target


def dbat(folder: Path) -> Iterator[Path]:
    bundled = HERE.parent / "src" / "baarda" / "data" / "camcal"
    camcal = folder / "camcal"
    for name in ("camcaldemo.xml", "reference/camcal-fixed.txt"):
        (camcal / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(bundled / name, camcal / name)
    for name, column, kept in (("images/images.txt", 0, 3), ("measurements/markpts.txt", 0, 3)):
        (camcal / name).parent.mkdir()
        lines = (bundled / name).read_text().splitlines()
        few = [line for line in lines if not line[:1].isdigit() or int(line.split(",")[column]) <= kept]
        (camcal / name).write_text("\n".join(few) + "\n")
    yield camcal / "camcaldemo.xml"
    source = _shared("dbat_sxb")
    if source is not None:
        for name in ("sxb.xml", "images/images.txt", "measurements/markpts.txt", "measurements/smartpts.txt", "reference/sxb-control.txt"):
            (folder / "sxb" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source / name, folder / "sxb" / name)
        many = folder / "sxb" / "measurements" / "smartpts.txt"
        many.write_text("\n".join(many.read_text().splitlines()[:150]) + "\n")
        yield folder / "sxb" / "sxb.xml"


def gama(folder: Path) -> Iterator[Path]:
    names = ("azimuth-angle", "azimuth-distance", "fixed-azimuth", "gama-local", "mikhail-7.4", "skorepa-dusek")
    yield from _copies(folder, *(f"gama_networks/{name}.gkf" for name in names))
    own = folder / "own" / "levels.gkf"
    own.parent.mkdir()
    own.write_text(_GAMA)
    yield own


_GAMA = """<?xml version="1.0"?>
<gama-local xmlns="http://www.gnu.org/software/gama/gama-local"><network axes-xy="en" angles="left-handed">
<description>by hand</description><parameters sigma-apr="10" conf-pr="0.95" sigma-act="apriori"/>
<points-observations distance-stdev="5 3 1" direction-stdev="10">
<point id="A" x="0" y="0" fix="xy"/><point id="B" x="100" y="0" fix="xy"/><point id="C" x="50" y="80" adj="XY"/>
<point id="D" z="1" fix="z"/><point id="E" z="2" fix="z"/><point id="F" adj="Z"/>
<obs from="A"><direction to="B" val="100"/><direction to="C" val="35.5"/><distance to="C" val="94.34"/></obs>
<obs from="B"><direction to="A" val="300"/><direction to="C" val="364.5"/><distance to="C" val="94.33"/></obs>
<height-differences><dh from="D" to="F" val="0.5" stdev="2"/><dh from="E" to="F" val="-0.5" stdev="2"/></height-differences>
</points-observations></network></gama-local>
"""


def libmv(folder: Path) -> Iterator[Path]:
    for order, letter in (("<", b"v"), (">", b"V")):
        path = folder / letter.decode() / "problem.bin"
        path.parent.mkdir()
        path.write_bytes(test_libmv.problem(order, letter + b"P"))
        yield path
    yield from _copies(folder, "libmv_tos_333/problem_01.bin")


def metashape(folder: Path) -> Iterator[Path]:
    for make in (test_format_metashape.psz, test_format_metashape.psx, test_format_metashape.xml):
        place = folder / make.__name__
        place.mkdir()
        yield make(place)[0]
    (folder / "geographic").mkdir()
    yield test_format_metashape.psz(folder / "geographic", crs=test_format_metashape.WGS84)[0]


def mrcal(folder: Path) -> Iterator[Path]:
    for kind, cameras in (("OPENCV4", 1), ("OPENCV8", 2)):
        (folder / kind).mkdir()
        yield test_format_mrcal.model(folder / kind, test_format_mrcal.inputs(kind, cameras))


def nvm(folder: Path) -> Iterator[Path]:
    for i, fixed in enumerate(("", "FixedK 800 320 800 240 -0.05")):
        (folder / str(i)).mkdir()
        yield test_format_nvm.scene(folder / str(i), fixed)


def openmvg(folder: Path) -> Iterator[Path]:
    for i, options in enumerate(({}, {"nested": True, "control": True}, {"kind": None, "control": True})):
        (folder / str(i)).mkdir()
        yield test_format_openmvg.scene(folder / str(i), **options)


def opensfm(folder: Path) -> Iterator[Path]:
    marks = (
        '{"points": [{"id": "a", "position": {"latitude": 52.5, "longitude": 13.4, "altitude": 30}, "observations": '
        '[{"shot_id": "0.jpg", "projection": [0.01, 0.02]}, {"shot_id": "1.jpg", "projection": [0.1, 0.2]}]}]}'
    )
    for kind in ("perspective", "brown"):
        (folder / kind).mkdir()
        test_format_opensfm.scene(folder / kind, kind, version=2 if kind == "brown" else 1)
        (folder / kind / "ground_control_points.json").write_text(marks)
        (folder / kind / "config.yaml").write_text("# settings\nreprojection_error_sd: 0.004\nprocesses: 1\n")
        yield folder / kind
    source = _shared("opensfm_berlin")
    if source is not None:
        yield _part_of_opensfm(source, folder / "berlin", 60)


def _part_of_opensfm(source: Path, target: Path, count: int) -> Path:
    """Copy a data set with fewer points."""
    target.mkdir()
    root = json.loads((source / "reconstruction_example.json").read_text())
    root[0]["points"] = dict(list(root[0]["points"].items())[:count])
    (target / "reconstruction.json").write_text(json.dumps(root[:1]))
    head, *rows = (source / "tracks_example.csv").read_text().splitlines()
    (target / "tracks.csv").write_text("\n".join([head, *(r for r in rows if r.split("\t")[1] in root[0]["points"])]) + "\n")
    for name in ("ground_control_points.json", "config.yaml"):
        shutil.copy(source / name, target)
    return target


def photomodeler(folder: Path) -> Iterator[Path]:
    names = (
        "dbat_camcal/pm/camcal-pmexport5.txt",
        "dbat_sxb/pm/f-op0-with-orient-pmexport.txt",
        "dbat_sxb/pm/w-op1-with-orient-pmexport.txt",
    )
    yield from _copies(folder, *names)


def project(folder: Path) -> Iterator[Path]:
    network = test_format_project.rich()
    write(network, folder / "rich", "project")
    yield folder / "rich"
    write(with_distances(ring(images=4, points=12), [(5, 6)]), folder / "ring", "project")
    yield folder / "ring" / "project.toml"
    for path in gama(folder):
        if path.parent.name == "own":
            write(read(path), folder / "gama", "project")
            yield folder / "gama"


def plainly_named(files: dict[str, bytes], entry: str) -> tuple[dict[str, bytes], str]:
    """Return files with the random identifiers in their names and contents (pyopf's) replaced by counted ones."""
    found = dict.fromkeys(m for text in (*files, *(c.decode("latin-1") for c in files.values())) for m in _RANDOM.findall(text))
    for i, old in enumerate(found):
        new = f"00000000-0000-4000-8000-{i:012d}"
        files = {n.replace(old, new): c.replace(old.encode(), new.encode()) for n, c in files.items()}
        entry = entry.replace(old, new)
    return files, entry


def _scenes(folder: Path, *makes: Callable[[Path], object]) -> Iterator[Path]:
    for i, make in enumerate(makes):
        (folder / str(i)).mkdir()
        make(folder / str(i))
        yield folder / str(i)


def aicon(folder: Path) -> Iterator[Path]:
    yield from _scenes(folder, test_format_aicon.scene, lambda f: test_format_aicon.scene(f, control=6))


def patb(folder: Path) -> Iterator[Path]:
    yield from _scenes(folder, test_format_patb_bingo.patb, lambda f: test_format_patb_bingo.patb(f, transposed=True))


def bingo(folder: Path) -> Iterator[Path]:
    yield from _scenes(folder, test_format_patb_bingo.bingo, lambda f: test_format_patb_bingo.bingo(f, omega_first=True))


def pix4d(folder: Path) -> Iterator[Path]:
    yield from _scenes(folder, test_format_pix4d.scene)


def opf(folder: Path) -> Iterator[Path]:
    yield from _scenes(folder, test_format_opf.scene, lambda f: test_format_opf.scene(f, with_gps=False))


def radar_csv(folder: Path) -> Iterator[Path]:
    for name, tracks in (("one", ("",)), ("two", ("A", "B"))):
        (folder / name).mkdir()
        rows = ["point,track,t,r,role,X,Y,Z,sigma_X,sigma_Y,sigma_Z,delay,order"]
        for track in tracks:
            rows += [
                f"P{i},{track},{10 + 3.7 * i},{400 + 31.3 * (i % 7)},control,{50 * i},{90 * (i % 7)},{5 * (i % 3)},1,1,2,5000,2"
                for i in range(14)
            ]
            rows += [f"Q{i},{track},{12 + 3.1 * i},{420 + 21.3 * (i % 5)},,,,,,,,5000,2" for i in range(6)]
        (folder / name / "radar.csv").write_text("\n".join(rows) + "\n")
        yield folder / name / "radar.csv"


def _base() -> Network:
    return ring(images=6, points=20, control=6, checks=2)


def control(folder: Path) -> Iterator[Path]:
    network = _base()
    (folder / "csv").mkdir()
    text = "".join(f"P{i},control,{0.1 * i},1,2,0.01,0.01,0.02,0.3,0.1,-0.2\n" for i in range(4)) + "P9,check,1,2,3,0.01,0.01,0.01,,,\n"
    head = test_format_control.HEAD.strip() + ",correlation_XY,correlation_XZ,correlation_YZ\n"
    yield test_format_control.table(folder / "csv", head + text)
    (folder / "plain").mkdir()
    labels = [p for p, role in zip(network.points.labels, network.points.roles, strict=True) if role != CHECK][:5]
    text = test_format_control.HEAD + test_format_control.rows(network, labels)
    yield test_format_control.table(folder / "plain", text)


def gcp_list(folder: Path) -> Iterator[Path]:
    (folder / "scene").mkdir()
    camera, pose, xyz = test_format_opensfm.scene(folder / "scene")
    for system, coordinates in (("LOCAL", xyz[:4]), ("WGS84", np.array([13.4, 52.5, 30.0]) + 1e-5 * xyz[:4])):
        (folder / system).mkdir()
        yield test_format_opensfm.control_list(folder / system, system, coordinates, pose, camera, xyz)


def camera_positions(folder: Path) -> Iterator[Path]:
    (folder / "table").mkdir()
    yield test_camera_positions.table(folder / "table" / "positions.csv", _base(), strips=2)


def residuals(folder: Path) -> Iterator[Path]:
    rng = np.random.default_rng(0)
    v = rng.standard_normal(40)
    (folder / "csv").mkdir()
    rows = [f"{'abc'[i % 3]},{x!r},1,0.5" for i, x in enumerate(v.tolist())]
    (folder / "csv" / "v.csv").write_text("\n".join(["image,residual,sigma,redundancy", *rows]) + "\n")
    yield folder / "csv" / "v.csv"
    for i, values in enumerate((v, v[:, None], np.array([(a, 1) for a in v], dtype=[("residual", "<f8"), ("image", "<i4")]))):
        (folder / f"npy{i}").mkdir()
        np.save(folder / f"npy{i}" / "v.npy", values)
        yield folder / f"npy{i}" / "v.npy"
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        return
    (folder / "parquet").mkdir()
    pq.write_table(pa.table({"residual": v, "image": ["a", "b"] * 20}), folder / "parquet" / "v.parquet")
    yield folder / "parquet" / "v.parquet"


#: readers of single tables, which are no formats of networks: chosen by an option of the command line, not recognised
TABLES: dict[str, Maker] = {"control": control, "gcp_list": gcp_list, "camera_positions": camera_positions, "residuals": residuals}


def base_folders(folder: Path) -> dict[str, Path]:
    """Write the networks that the tables of control and positions belong to, by reader."""
    for name in ("ring", "scene"):
        (folder / name).mkdir(parents=True)
    write(replace(_base(), settings={}), folder / "ring" / "project", "project")
    test_format_opensfm.scene(folder / "scene")
    ring_project = folder / "ring" / "project"
    return {"control": ring_project, "camera_positions": ring_project, "gcp_list": folder / "scene"}


def makers() -> dict[str, Maker]:
    """Return the maker of every format that has one, and of the tables."""
    found: dict[str, Maker] = {name: globals()[key] for name in formats() if (key := name.replace("-", "_")) in globals()}
    return {**found, **TABLES}


def timeless(data: bytes) -> bytes:
    """Return an archive without the time at which it was written, also one that a text carries in base 85; other content as it is."""
    if data.startswith(b"PK"):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return packed([(i.filename, archive.read(i)) for i in archive.infolist()])
    found = BLOB.search(data)
    if found is None:
        return data
    return data[: found.start(1)] + base64.b85encode(timeless(base64.b85decode(found[1]))) + data[found.end(1) :]


def seeds(reader: str) -> list[Seed]:
    """Return the seeds of a reader, in the same order and with the same bytes every time."""
    out = []
    with tempfile.TemporaryDirectory(prefix="seeds-") as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(temporary)
        for entry in makers()[reader](folder):
            top = folder / entry.relative_to(folder).parts[0]
            files = {p.relative_to(top).as_posix(): timeless(p.read_bytes()) for p in sorted(top.rglob("*")) if p.is_file()}
            out.append(Seed(reader, top.name, *plainly_named(files, entry.relative_to(top).as_posix())))
    return out
