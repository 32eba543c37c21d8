"""Damage to files: bytes, numbers, lines, and the trees inside JSON, XML, zip, gzip, bzip2 and NumPy files.

Every mutation draws from the generator that it is given and from nothing else, so a case is known by its seed and its number.
"""

from __future__ import annotations

import base64
import bz2
import copy
import gzip
import io
import json
import random
import re
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable
from typing import Any

Damage = Callable[[bytes, random.Random], bytes]

NUMBERS = [
    *("0", "-0", "1", "-1", "2", "0.5", "1e-320", "1e308", "-1e308", "1e400", "nan", "inf", "-Infinity", "NaN", "1_000", "0x10", "1e", "."),
    *("2147483647", "-2147483648", "4294967295", "4294967296", "9223372036854775807", "9223372036854775808", "18446744073709551615"),
    *("99999999999999999999", "9" * 400, "1" + "0" * 5000, "1e15", "-1e15", "1e9", "1e-9", "\u0661\u0662", "+7", "1,5", ""),
]
PLACES = [
    "../../../../etc/passwd",
    "/etc/passwd",
    "/dev/zero",
    "/proc/self/environ",
    "..",
    ".",
    "/",
    "C:\\x",
    "\\\\host\\share",
    "a\u0000b",
]
LABELS = [
    *("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "{{ 7 * 7 }}", "{0.__class__}", "%s%n", "$HOME", "\u202egpj.exe"),
    *("\x1b[31m", "\x00", "\r", "\u2028", "\ud800", "=1+1", "'; drop", "a" * 100_000, " ", "", "\u0130", "None", "__proto__"),
]
WORDS = [
    *(
        b"0",
        b"-1",
        b"1e400",
        b"nan",
        b'"',
        b"'",
        b"{",
        b"[",
        b"]",
        b"}",
        b"<",
        b">",
        b"\x00",
        b"\xff",
        b"\xfe\xff",
        b"\xef\xbb\xbf",
        b"9" * 400,
    ),
    *(
        b"null",
        b"true",
        b"\n",
        b"\r",
        b"\t",
        b",",
        b";",
        b"e",
        b"#",
        b"\\",
        b"\x1b[2J",
        b"&",
        b"%",
        b"\xc0\x80",
        b"\xed\xa0\x80",
        b" " * 3000,
    ),
]
ENTITIES = (
    '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]>',
    '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]>',
    '<!DOCTYPE x SYSTEM "file:///etc/passwd">',
)
_NUMBER = re.compile(rb"(?<![\w.])[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_NAME = re.compile(rb"[A-Za-z_][\w.$/\\-]{2,60}")
_TAG = re.compile(rb"<[A-Za-z/][^<>]{0,400}>")
_ATTRIBUTE = re.compile(rb'="([^"<>]{0,400})"')
BLOB = re.compile(rb"b'([0-9A-Za-z!#$%&()*+;<=>?@^_`{|}~-]{40,})'")  # base 85, as mrcal carries arrays


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return a file with one to three pieces of damage."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data = rng.choice(_fitting(data))(data, rng)
    return data


def _fitting(data: bytes) -> list[Damage]:
    """Return the kinds of damage that suit a content; those that know its structure are drawn more often."""
    head = data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")
    if data.startswith(b"PK"):
        return [_zip, _zip, _zip, _zip_directory, _bytes]
    if data.startswith((b"BZh", b"\x1f\x8b")):
        return [_packed, _packed, _packed, _bytes]
    if data.startswith(b"\x93NUMPY"):
        return [_numpy_header, _bytes, _whole_words]
    if head.startswith((b"{", b"[")) and BLOB.search(data) is None:
        return [_json, _json, _json, _json, _number, _lines, _bytes]
    if head.startswith(b"<"):
        return [_xml, _xml, _xml, _attribute, _attribute, _number, _lines, _bytes]
    if b"\x00" in data[:2000]:
        return [_bytes, _bytes, _whole_words, _whole_words]
    return [_number, _number, _lines, _fields, _fields, _name, _bytes, *([_blob] * 6 if BLOB.search(data) else [])]


def _bytes(data: bytes, rng: random.Random) -> bytes:
    a = rng.randrange(len(data) + 1)
    b = min(len(data), a + rng.choice((0, 1, 1, 2, 5, 20, 200, 5000)))
    kind = rng.randrange(7)
    if kind == 0:
        return data[:a] + data[b:]
    if kind == 1:
        return data[:a] + data[a:b] * rng.choice((2, 2, 2, 50)) + data[b:]
    if kind == 2:
        return data[:a] + rng.choice(WORDS) + data[b:]
    if kind == 3:
        return data[:a] + rng.randbytes(b - a) + data[b:]
    if kind == 4:
        return data[:a]
    if kind == 5 and a < len(data):
        return data[:a] + bytes([data[a] ^ 1 << rng.randrange(8)]) + data[a + 1 :]
    c = rng.randrange(len(data) + 1)
    return data[:a] + data[c : c + b - a] + data[b:]  # a piece from elsewhere


def _whole_words(data: bytes, rng: random.Random) -> bytes:
    """Replace 4 or 8 bytes at an even place by a number that is at an edge: counts, offsets and floats of binary files."""
    width = rng.choice((4, 8))
    a = rng.randrange(max(1, len(data) // 4)) * 4 + rng.choice((0, 0, 0, 1, 2))
    value = rng.choice(
        (0, 1, 2, 255, 2 ** (8 * width - 1) - 1, 2 ** (8 * width - 1), 2 ** (8 * width) - 1, 0x7FF0000000000000 >> (64 - 8 * width))
    )
    return data[:a] + value.to_bytes(width, rng.choice(("little", "little", "big"))) + data[a + width :]


def _one_of(found: list[re.Match[bytes]], rng: random.Random) -> re.Match[bytes] | None:
    return rng.choice(found) if found else None


def _near(pattern: re.Pattern[bytes], data: bytes, rng: random.Random) -> re.Match[bytes] | None:
    """Return a match near a random place, or near the beginning, where headers and counts stand."""
    start = 0 if rng.random() < 0.3 else rng.randrange(len(data) + 1)
    return _one_of(list(pattern.finditer(data, start, start + 3000)), rng)


def _number(data: bytes, rng: random.Random) -> bytes:
    found = _near(_NUMBER, data, rng)
    if found is None:
        return _bytes(data, rng)
    if rng.random() < 0.3 and found[0].isdigit() and len(found[0]) < 18:
        new = str(int(found[0]) + rng.choice((-1, 1, 2, 10, 1000)))
    else:
        new = rng.choice(NUMBERS)
    return data[: found.start()] + new.encode() + data[found.end() :]


def _name(data: bytes, rng: random.Random) -> bytes:
    found = _near(_NAME, data, rng)
    if found is None:
        return _bytes(data, rng)
    other = _near(_NAME, data, rng)
    new = rng.choice((rng.choice(PLACES), rng.choice(LABELS), None))
    text = new.encode("utf-8", "surrogatepass") if new is not None else other[0] if other else b"x"
    return data[: found.start()] + text + data[found.end() :]


def _lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(7)
    if kind == 0:
        del lines[i]
    elif kind == 1:
        lines[i:i] = [lines[i]] * rng.choice((1, 1, 30))
    elif kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == 3:
        lines[i] = b"".join(lines[i : i + 2])
        del lines[i + 1 : i + 2]
    elif kind == 4:
        del lines[i : i + rng.choice((2, 10, 100))]
    elif kind == 5:
        lines[i] = lines[i] + rng.choice((b"\r", b"\x0b", b"\x1c", b" ", b",,,,,,,,", b"\t#"))
    else:
        lines[i] = lines[j]
    return b"\n".join(lines)


def _fields(data: bytes, rng: random.Random) -> bytes:
    """Delete, double, swap or replace a field of a line."""
    lines = data.split(b"\n")
    i = rng.randrange(min(len(lines), 12)) if rng.random() < 0.3 else rng.randrange(len(lines))
    separator = next((s for s in (b",", b";", b"\t", b" ") if s in lines[i]), b" ")
    fields = lines[i].split(separator)
    k, m = rng.randrange(len(fields)), rng.randrange(len(fields))
    kind = rng.randrange(5)
    if kind == 0:
        del fields[k]
    elif kind == 1:
        fields[k:k] = [fields[k]] * rng.choice((1, 1, 200))
    elif kind == 2:
        fields[k], fields[m] = fields[m], fields[k]
    else:
        words = NUMBERS if kind == 3 else [*LABELS, *PLACES, '"', '"a', 'a"b', "#", "none"]
        fields[k] = rng.choice(words).encode("utf-8", "surrogatepass")
    lines[i] = separator.join(fields)
    return b"\n".join(lines)


def _json(data: bytes, rng: random.Random) -> bytes:
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return _bytes(data, rng)
    way: list[tuple[Any, Any]] = []
    at = tree
    stop = rng.choice((0.02, 0.1, 0.3))
    while isinstance(at, (dict, list)) and at and not (way and rng.random() < stop):
        key = rng.choice(list(at)) if isinstance(at, dict) else rng.randrange(len(at))
        way.append((at, key))
        at = at[key]
    if not way:
        return b"[]" if rng.random() < 0.5 else b"{}"
    parent, key = way[-1]
    kind = rng.randrange(10)
    if kind == 0:
        del parent[key]
    elif kind == 1 and isinstance(parent, dict):
        parent[rng.choice([*LABELS[:-6], *PLACES, str(key) + "x", "0", "-1", str(10**30)])] = parent.pop(key)
    elif kind == 2 and isinstance(parent, list):
        parent[key:key] = [copy.deepcopy(at) for _ in range(rng.choice((1, 1, 40)))]
    elif kind == 3:
        parent[key] = [at]
    elif kind == 4:
        parent[key] = {str(key): at}
    elif kind == 5:
        other, place = rng.choice(way)
        try:
            parent[key] = copy.deepcopy(other[place]) if other is not parent else None
        except RecursionError:  # earlier damage nested it too deeply
            parent[key] = None
    elif kind == 6:
        for _ in range(rng.choice((5, 60, 900))):
            at = [at]
        parent[key] = at
    else:
        parent[key] = rng.choice(
            (None, True, False, [], {}, 0, -1, 0.5, 1e308, -1e308, 2**31, 2**63, 10**30, *LABELS, *PLACES, *NUMBERS[:12])
        )
    text = json.dumps(tree, indent=rng.choice((None, 1)))
    if rng.random() < 0.05:
        text = text.replace("1", rng.choice(("NaN", "-Infinity", "1e999", "9" * 5000)), 1)
    return text.encode()


def _xml(data: bytes, rng: random.Random) -> bytes:
    found = _near(_TAG, data, rng)
    if found is None:
        return _bytes(data, rng)
    a, b = found.span()
    kind = rng.randrange(8)
    if kind == 0:
        return data[:a] + data[b:]
    if kind == 1:
        name = re.match(rb"</?([\w:.-]*)", found[0])[1]  # type: ignore[index]
        end = data.find(b"</" + name + b">", b)
        whole = data[a : end + len(name) + 3] if end >= 0 else found[0]
        return data[:a] + (whole * rng.choice((0, 2, 2, 40))) + data[a + len(whole) :]
    if kind == 2:
        depth = rng.choice((3, 50, 2000))
        return data[:b] + b"<x>" * depth + b"</x>" * depth + data[b:]
    if kind == 3:
        start = data.find(b"?>") + 2 if b"?>" in data[:200] else 0
        text = rng.choice(ENTITIES).encode()
        return data[:start] + text + data[start:b] + rng.choice((b"&c;", b"&e;", b"")) + data[b:]
    if kind == 4:
        end = data.find(b"<", b)
        word = rng.choice([*NUMBERS, *PLACES, *[n for n in LABELS if "<" not in n]]).encode("utf-8", "surrogatepass")
        return data[:b] + word + data[end if end >= 0 else b :]
    if kind == 5:
        return data[:b] + rng.choice((b"<![CDATA[ ]]>", b"<!-- x -->", b"<?x y?>", b"&#0;", b"&#x1b;", b"&lt;b&gt;", b"\x00")) + data[b:]
    if kind == 6:
        names = re.sub(rb"[A-Za-z]", lambda _: bytes([rng.choice(b"abcxyz")]), found[0], count=rng.choice((1, 3)))
        return data[:a] + names + data[b:]
    return re.sub(rb'encoding="[^"]*"', b'encoding="' + rng.choice((b"utf-16", b"utf-7", b"zip", b"idna", b"cp037")) + b'"', data, count=1)


def _attribute(data: bytes, rng: random.Random) -> bytes:
    found = _near(_ATTRIBUTE, data, rng)
    if found is None:
        return _xml(data, rng)
    if rng.random() < 0.15:
        a = data.rfind(b" ", 0, found.start())
        return data[: max(a, 0)] + data[found.end() :]
    text = rng.choice([*NUMBERS, *PLACES, *LABELS]).replace("<", "&lt;").replace('"', "&quot;")
    return data[: found.start(1)] + text.encode("utf-8", "surrogatepass") + data[found.end(1) :]


def _zip(data: bytes, rng: random.Random) -> bytes:
    """Damage one part and pack the archive again: a part, its name, its method, its size."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = [(i.filename, archive.read(i)) for i in archive.infolist()]
    except (zipfile.BadZipFile, OSError, ValueError, EOFError, RuntimeError, NotImplementedError, zlib.error):
        return _bytes(data, rng)
    if not parts:
        return _bytes(data, rng)
    k = rng.randrange(len(parts))
    name, content = parts[k]
    kind = rng.randrange(12)
    method = zipfile.ZIP_DEFLATED
    if kind == 0:
        del parts[k]
    elif kind == 1:
        parts[k] = (rng.choice([*PLACES[:-1], name.upper(), name + "/", "/" + name]), content)
    elif kind == 2:
        parts.append((name, mutated(content, rng)))  # the same name twice
    elif kind == 3:
        parts[k] = (name, bytes(rng.choice((2**21, 2**23))))  # zeros pack a thousandfold
    elif kind == 4:
        method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    else:
        parts[k] = (name, mutated(content, rng))
    return packed(parts, method)


def packed(parts: Iterable[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return a zip archive that does not depend on the time."""
    out = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that come twice
        with zipfile.ZipFile(out, "w", method) as archive:
            for part, text in parts:
                archive.writestr(zipfile.ZipInfo(part), text, method)
    return out.getvalue()


def _zip_directory(data: bytes, rng: random.Random) -> bytes:
    """Change a header of the archive: versions, methods, flags, sizes and offsets that lie."""
    heads = [m.start() for m in re.finditer(rb"PK(?:\x01\x02|\x03\x04|\x05\x06)", data)]
    if not heads:
        return _bytes(data, rng)
    at = rng.choice(heads) + rng.randrange(4, 46)
    value = rng.choice((0, 1, 8, 99, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF))
    width = 2 if value < 2**16 else 4
    return data[:at] + value.to_bytes(width, "little") + data[at + width :]


def _packed(data: bytes, rng: random.Random) -> bytes:
    """Damage the text inside gzip or bzip2, or replace it by one that unpacks a thousandfold."""
    module: Any = bz2 if data.startswith(b"BZh") else gzip
    try:
        text = module.decompress(data)
    except (OSError, EOFError, ValueError, zlib.error):
        return _bytes(data, rng)
    if rng.random() < 0.1:
        text = rng.choice((text[:200] + b" " * 2**22, b"0 " * 2**20, text[: 2**16] * 128))
    else:
        text = mutated(text, rng)
    small = gzip.compress(text, mtime=0) if module is gzip else bz2.compress(text)
    return small * 2 if rng.random() < 0.05 else small


def _numpy_header(data: bytes, rng: random.Random) -> bytes:
    """Replace shape, order or type in the header of a NumPy file and keep its length."""
    if not data.startswith(b"\x93NUMPY") or len(data) < 12:
        return _bytes(data, rng)
    end = 10 + int.from_bytes(data[8:10], "little")
    header = data[10:end]
    old, new = rng.choice(
        [
            (
                rb"\([^)]*\)",
                rng.choice((b"(-1,)", b"(-2, -3)", b"(0,)", b"(9999999999,)", b"()", b"(True,)", b"(3, 2)", b"(2, 0)", b"(1e3,)")),
            ),
            (
                rb"'descr': [^,]*",
                b"'descr': " + rng.choice((b"'|O'", b"'<f4'", b"'>f8'", b"'<c16'", b"'|S0'", b"'<U1'", b"'<M8[s]'", b"[('a','<f8')]")),
            ),
            (rb"False|True", rng.choice((b"True", b"1", b"None"))),
            (rb"\{", rng.choice((b"(", b"{{", b"[" * 40))),
        ]
    )
    header = re.sub(old, lambda _: new, header, count=1)
    if rng.random() < 0.8:
        header = header.rstrip()[: end - 11].ljust(end - 11) + b"\n"
    return data[:10] + header + data[end:]


def _blob(data: bytes, rng: random.Random) -> bytes:
    """Damage the archive of arrays that a text carries in base 85."""
    found = BLOB.search(data)
    if found is None:
        return _bytes(data, rng)
    try:
        inner = base64.b85decode(found[1])
    except ValueError:
        return _bytes(data, rng)
    return data[: found.start(1)] + base64.b85encode(_zip(inner, rng)) + data[found.end(1) :]
