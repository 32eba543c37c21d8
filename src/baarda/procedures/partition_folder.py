"""A partitioned project: a folder with `partition.json` and one project folder per part, which only its own worker reads."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from baarda.adjustment.camera_choice import with_cameras
from baarda.adjustment.initial import complete
from baarda.adjustment.solve import Settings, prepare
from baarda.errors import InputError, UsageError
from baarda.formats.folder import Mark, whole_folder
from baarda.formats.project_writer import project_files
from baarda.network import Network
from baarda.procedures.partition import Partition, border_nodes, part_network, partition

__all__ = ["PartFolder", "PartitionFolder", "is_partition", "read_partition", "split_network", "write_partition"]

FILE = "partition.json"
SCHEMA = "baarda.partition/1"
LARGEST = 1 << 28  # bytes of an index


@dataclass(frozen=True)
class PartFolder:
    """What the index says of one part.

    Attributes
    ----------
    folder : str
        Name of its project folder within the partition.
    images, points, observations : int
        How many it holds; images of the border count in every part that holds them.
    border : tuple of int
        Places of its border nodes in the border of the whole network.
    owned : tuple of int
        Those of them that this part is the first to hold: it writes their rows of the tables, and holds what is observed of them directly.
    sha256 : str
        Over the names and contents of its files.
    """

    folder: str
    images: int
    points: int
    observations: int
    border: tuple[int, ...]
    owned: tuple[int, ...]
    sha256: str


@dataclass(frozen=True)
class PartitionFolder:
    """A partitioned project.

    Attributes
    ----------
    path : Path
    parts : tuple of PartFolder
    border : tuple of (str, str)
        Kind and label of each node that stands in several parts, in the order of the unknowns.
    centroid : tuple of float
        By which the adjustment reduces the coordinates.
    counts : mapping of str to int
        Of the whole network: images, cameras, object_points, observations.
    name, unit : str
    """

    path: Path
    parts: tuple[PartFolder, ...]
    border: tuple[tuple[str, str], ...]
    centroid: tuple[float, float, float]
    counts: Mapping[str, int]
    name: str = ""
    unit: str = "m"

    def place(self, number: int) -> Path:
        """Return the project folder of a part."""
        return self.path / self.parts[number].folder

    @property
    def sha256(self) -> str:
        """Of the index, which holds those of the parts."""
        return hashlib.sha256((self.path / FILE).read_bytes()).hexdigest()


def is_partition(path: Path) -> bool:
    """Return whether a path is the folder of a partitioned project, or its index."""
    file = path / FILE if path.is_dir() else path
    if file.name != FILE or not file.is_file():
        return False
    with file.open("rb") as f:
        return f'"schema": "{SCHEMA}"'.encode() in f.read(400)


def split_network(network: Network, camera: Any = None) -> tuple[Network, list[str]]:
    """Return a network that can be split: camera models as asked for, start values for all that takes part; and notes.

    Parameters
    ----------
    network : Network
    camera : str or tuple of str, optional
        As `Settings.camera`; None is what the source says.

    Raises
    ------
    Singular, UsageError
        See `baarda.adjust`.
    """
    settings = Settings.of(network, {"camera": camera})
    network, notes = with_cameras(network, settings.camera)
    network = replace(network, settings={k: v for k, v in network.settings.items() if k != "camera"})
    prepared, aside, _ = prepare(network, replace(settings, camera=None))
    started, more = complete(prepared, aside)
    points = replace(network.points, coordinates=started.points.coordinates)
    images = replace(network.images, position=started.images.position, rotation=started.images.rotation)
    notes += more
    said = (*network.assumptions, *notes)
    return replace(network, points=points, images=images, declared=started.declared, assumptions=said), notes


def write_partition(network: Network, parts: int, out: str | Path, camera: Any = None) -> PartitionFolder:
    """Split a network and write the partitioned project.

    Parameters
    ----------
    network : Network
    parts : int
    out : str or Path
        The folder, there whole or not at all; an earlier partitioned project there is replaced.
    camera : str or tuple of str, optional
        Camera parameters to estimate, or a preset, as `Settings.camera`: the parts must agree on them.

    Returns
    -------
    PartitionFolder

    Raises
    ------
    UsageError
        If the network cannot be split into so many parts.
    OutputError
        If the folder cannot be written; nothing is left behind.

    Examples
    --------
    >>> import tempfile
    >>> from baarda.procedures.synthetic import synthetic
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     made = write_partition(synthetic("aerial", 12).network, 2, Path(folder) / "parts")
    ...     [p.folder for p in made.parts], made == read_partition(made.path)
    (['part-000', 'part-001'], True)
    """
    network, _ = split_network(network, camera)
    split = partition(network, parts)
    border = border_nodes(network, split)
    target = Path(out)
    width = max(3, len(str(parts - 1)))
    mark = Mark(FILE, "baarda.partition/", (FILE, *(f"part-{k:0{w}}" for w in range(3, 7) for k in range(min(10**w, 4 * parts + 1000)))))
    with whole_folder(target, mark) as folder:
        told = []
        for k in range(parts):
            part = part_network(network, split, k)
            name = f"part-{k:0{width}}"
            told.append(_write_part(part, folder / name, name, split, border, k))
        counts = {
            "images": len(network.images.labels),
            "cameras": len(network.cameras),
            "object_points": len(network.points.labels),
            "observations": sum(len(g) * len(g.components) for g in network.observations),
        }
        x, y, z = network.centroid().tolist()
        nodes = tuple((kind, _label(network, kind, node)) for kind, node in border)
        write_index(PartitionFolder(folder, tuple(told), nodes, (x, y, z), counts, network.name, network.unit))
    return read_partition(target)


def write_index(folder: PartitionFolder) -> None:
    """Write `partition.json` into the folder.

    Parameters
    ----------
    folder : PartitionFolder
    """
    index = {
        "schema": SCHEMA,
        "name": folder.name,
        "unit": folder.unit,
        "centroid": list(folder.centroid),
        "counts": dict(folder.counts),
        "border": [list(node) for node in folder.border],
        "parts": [{**vars(p), "border": list(p.border), "owned": list(p.owned)} for p in folder.parts],
    }
    (folder.path / FILE).write_text(json.dumps(index, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def _write_part(part: Network, folder: Path, name: str, split: Partition, border: Sequence[tuple[str, int]], number: int) -> PartFolder:
    sha256 = write_files(part, folder)
    mine = [i for i, (kind, node) in enumerate(border) if split.members[kind][number, node]]
    owned = [i for i in mine if split.owner[border[i][0]][border[i][1]] == number]
    rows = sum(len(g) * len(g.components) for g in part.observations)
    return PartFolder(name, len(part.images.labels), len(part.points.labels), rows, tuple(mine), tuple(owned), sha256)


def write_files(part: Network, folder: Path) -> str:
    """Write the project of a part and return its sha256; who repeats it writes the same again.

    Parameters
    ----------
    part : Network
    folder : Path

    Returns
    -------
    str
        Over the sorted names, sizes and contents of the files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    total = hashlib.sha256()
    for file, text in sorted(project_files(part).items()):
        data = text.encode("utf-8")
        total.update(len(file).to_bytes(8, "little") + file.encode() + len(data).to_bytes(8, "little") + data)
        (folder / file).write_bytes(data)
    return total.hexdigest()


def _label(network: Network, kind: str, node: int) -> str:
    if kind == "camera":
        return network.cameras[node].label
    if kind == "image":
        return network.images.labels[node]
    return next(d.labels[node] for d in network.declared if d.kind == kind)


def read_partition(path: str | Path) -> PartitionFolder:
    """Read the index of a partitioned project.

    Parameters
    ----------
    path : str or Path
        The folder, or `partition.json` in it.

    Returns
    -------
    PartitionFolder

    Raises
    ------
    InputError
        If the index cannot be used.
    """
    where = Path(path)
    file = where / FILE if where.is_dir() else where
    if not is_partition(where):
        raise InputError(f"no partitioned project: its index {FILE} with the schema {SCHEMA} is missing", where)
    if file.stat().st_size > LARGEST:
        raise InputError("the index is too large", file)
    try:
        index = json.loads(file.read_text(encoding="utf-8"))
        border = tuple((str(kind), str(label)) for kind, label in index["border"])
        parts = tuple(
            PartFolder(
                str(p["folder"]), int(p["images"]), int(p["points"]), int(p["observations"]),
                tuple(int(i) for i in p["border"]), tuple(int(i) for i in p["owned"]), str(p["sha256"]),
            )
            for p in index["parts"]
        )  # fmt: skip
        x, y, z = (float(c) for c in index["centroid"])
        counts = {str(k): int(v) for k, v in index["counts"].items()}
        name, unit = str(index["name"]), str(index["unit"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"the index cannot be used: {type(error).__name__}: {error}", file) from None
    if not parts:
        raise InputError("there are no parts", file)
    owners = np.zeros(len(border), dtype=int)
    for p in parts:
        if Path(p.folder).name != p.folder or not (file.parent / p.folder).is_dir():
            raise InputError(f"the folder {p.folder!r} of a part is missing", file)
        if any(not 0 <= i < len(border) for i in p.border) or not set(p.owned) <= set(p.border):
            raise InputError(f"part {p.folder}: border nodes that do not exist", file)
        owners[list(p.owned)] += 1
    if (owners != 1).any():
        raise InputError("each border node must be owned by exactly one part", file)
    return PartitionFolder(file.parent, parts, border, (x, y, z), counts, name, unit)


def mismatch(place: Path, sha256: str) -> bool:
    """Return whether the files of a part are not those that were written with the index."""
    total = hashlib.sha256()
    for file in sorted(p for p in place.iterdir() if p.is_file()):
        data = file.read_bytes()
        total.update(len(file.name).to_bytes(8, "little") + file.name.encode() + len(data).to_bytes(8, "little") + data)
    return total.hexdigest() != sha256


def check_parts(parts: int) -> None:
    """Refuse a number of parts that makes no sense.

    Raises
    ------
    UsageError
    """
    if not 1 <= parts <= 100_000:
        raise UsageError(f"the number of parts (--parts) must be between 1 and 100000, not {parts}")
