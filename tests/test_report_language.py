"""The report in German: every text of the sections has its translation, names stay names, JSON stays English."""

import ast
import re
import string
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import baarda
from baarda.cli import app
from baarda.errors import InputError, UsageError
from baarda.formats import dbat
from baarda.procedures.testing import analyse
from baarda.report import page
from baarda.report.result_folder import result_json
from baarda.report.sections.base import Cell, Column, DataTable, Section, say, translated
from baarda.report.translation import LANGUAGES, catalogue, current, language, parse_catalogue, tr
from networks import ring

REPORT = Path(baarda.__file__).parent / "report"
#: Which arguments of which calls are texts that a reader sees.
TEXTS = {
    "say": (0,), "tr": (0,), "plural": (1, 2), "Column": (0, 1, 2), "Cell": (0,), "DataTable": (0,), "Figure": (1, 2, 3),
    "Interactive": (1, 2, 3), "Paragraph": (0,), "Items": (0,), "SectionMaker": (2,), "Sentence": (0, 1),
}  # fmt: skip
#: Symbols, formulas and names that read the same in every language.
SAME = re.compile(
    r"RMSE\w*|CE90|LE90|AICc?|BIC|Jarque-Bera|v'Pv|alpha_outlier|correlation_limit|baarda|python|numpy|scipy|matplotlib|s[XYZ]|"
    r"[\d. ()/²+XYZsqrt_]*(RMSE|s[XYZ])[\w ²+()/]*|[^A-Za-z]*[A-Za-z]?[^A-Za-z]*|px|sigma0?|tau|MDB|vPv|max|min|principal_\w+|log L|"
    r"kappa|omega|phi|d / s|s\(d\)|x²/q|rms|outside (upper|lower) \w+|result.json"
)


@pytest.fixture(scope="module")
def calibration(camcal):
    return analyse(baarda.adjust(dbat.read(camcal)))


@pytest.fixture(scope="module")
def aerial(data):
    return analyse(baarda.adjust(dbat.read(data("dbat_sxb") / "sxb.xml")))


def constants(node):
    """String constants of an expression that may become its value; parts of f-strings are none."""
    if isinstance(node, ast.Constant):
        return [node.value] if isinstance(node.value, str) else []
    if isinstance(node, ast.IfExp):
        return constants(node.body) + constants(node.orelse)
    if isinstance(node, ast.BinOp):
        return constants(node.left) + constants(node.right)
    if isinstance(node, ast.BoolOp):
        return [c for v in node.values for c in constants(v)]
    return []


def texts(path):
    """Texts of a module: what stands in the calls of `TEXTS`, and every other constant that is a sentence."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docs = {
        id(n.body[0].value)
        for n in ast.walk(tree)
        if isinstance(n, (ast.Module, ast.FunctionDef, ast.ClassDef)) and n.body and isinstance(n.body[0], ast.Expr)
    }
    pieces = {id(v) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for v in ast.walk(n)}
    for n in ast.walk(tree):
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Name) and n.func.id in TEXTS:
            for k in TEXTS[n.func.id]:
                if k < len(n.args):
                    yield from constants(n.args[k])
        if (
            isinstance(n, ast.Constant)
            and isinstance(n.value, str)
            and id(n) not in docs | pieces
            and re.search("[a-z]{2,} [a-z]{2,}", n.value)
        ):
            yield n.value


def fields(template):
    return {name for _, name, _, _ in string.Formatter().parse(template) if name is not None}


@pytest.mark.parametrize("code", [c for c in LANGUAGES if c != "en"])
def test_every_text_of_the_sections_has_a_translation(code):
    known = catalogue(code)
    files = [*sorted((REPORT / "sections").glob("*.py")), REPORT / "scene.py", REPORT / "residual_sections.py"]
    files += [REPORT / f"{verb}_{part}.py" for verb in ("residual", "simulation") for part in ("report", "verdict")]
    files += [REPORT / "comparison_report.py", REPORT / "batch_report.py"]
    files += [REPORT / "resection_report.py", REPORT / "planimetry_height_report.py", REPORT / "helmert_report.py"]
    missing = {f"{f.name}: {t}" for f in files for t in texts(f) if t and t not in known and not SAME.fullmatch(t)}
    words = re.findall(r'tr\("([^"]+)"\)', (REPORT / "texts" / "report.html.j2").read_text(encoding="utf-8"))
    missing |= {f"report.html.j2: {w}" for w in words if w not in known}
    assert not missing, f"add these to texts/{code}.po:\n" + "\n".join(sorted(missing))


@pytest.mark.parametrize("code", [c for c in LANGUAGES if c != "en"])
def test_translations_keep_the_fields(code):
    """A translation may leave out a word of grammar, but no number; of notes whose numbers are counted, the 1 of 1'v may stand as it is."""
    for source, target in catalogue(code).items():
        assert fields(target) <= fields(source), source
        assert {f for f in fields(source) - fields(target) if not f.isdigit()} <= {"verb"}, source
        assert source[:1].isspace() == target[:1].isspace() and source[-1:].isspace() == target[-1:].isspace(), source


def test_german_verdict_of_the_calibration(calibration):
    with language("de"):
        assert page.verdict(calibration) == [
            "Die Ausgleichung ist in 8 Iterationen konvergiert: 4148 Beobachtungen bestimmen 423 Unbekannte mit einer Redundanz von 3725, "
            "im Mittel 0.90 je Beobachtung.",
            "Der Varianzfaktor 2.608 liegt außerhalb von 0.955..1.046: Die Verbesserungen sind 1.61-mal so groß, wie es die "
            "A-priori-Sigmas versprechen.",
            "Alle 6 zusätzlichen Kameraparameter unterscheiden sich zum Niveau 0.05 signifikant von null (kleinstes |t| = 11.2 für P2, "
            "Grenzwert 1.96).",
            "Eines groben Fehlers verdächtig: 45 von 4148 Beobachtungen (|tau| über 3.29; der Zufall allein zeigte 4.1); die schlimmste "
            "ist Bild 19 Punkt 8 x mit tau = -5.86: geschätzter Fehler 1.03 px. 31 davon häufen sich an den Punkten 1004, 1003, 1001, "
            "1002.",
            "Ein grober Fehler in einer Bildkoordinate wird mit Wahrscheinlichkeit 0.80 ab 0.43 px gefunden (Median, mit den "
            "A-priori-Sigmas); die am wenigsten kontrollierte, Bild 21 Punkt 11 x, kann bis zu 0.50 px verbergen.",
            "Die Objektpunkte haben Standardabweichungen von 0.039 / 0.039 / 0.065 mm in X / Y / Z (Mediane, a posteriori); der "
            "schwächste ist Punkt 90 mit 0.112 mm im Raum.",
            "Die Verbesserungen sind nicht die normaler Fehler (Anderson-Darling 24.63, Grenzwert 0.72, p = 0.001 aus simulierten "
            "Ausgleichungen); von den versuchten Verteilungen passt die Student-Verteilung nach AIC am besten.",
        ]


def test_german_verdict_of_the_aerial_block(aerial):
    with language("de"):
        whole = " ".join(page.verdict(aerial))
    assert (
        "2 Kontrollpunkte weichen von der Vermessung um mehr ab, als die vorhergesagte Genauigkeit erlaubt (T = 11.99, Grenzwert 2.10"
        in whole
    )
    assert "5 von 14 Punkten sind einzeln verworfen, am stärksten 492." in whole


def test_german_page_has_german_titles_and_the_same_numbers(aerial):
    english = page.sections(aerial)
    with language("de"):
        german = page.sections(aerial)
        text = page.html(aerial, german)
    assert '<html lang="de">' in text and "<h1>" in text and "Ausgleichungsbericht" in text
    assert [s.id for s in german] == [s.id for s in english]
    assert not {s.title for s in german} & {s.title for s in english}
    numbers = re.compile(r"\d+\.\d+")
    for a, b in zip(english, german, strict=True):
        for x, y in zip(a.blocks, b.blocks, strict=True):
            assert type(x) is type(y)
            if isinstance(x, DataTable):
                for row, other in zip(x.rows, y.rows, strict=True):
                    for p, q in zip(row, other, strict=True):
                        told = [c.text if isinstance(c, Cell) else c for c in (p, q)]
                        assert numbers.findall(told[0]) == numbers.findall(told[1]), told


def test_json_stays_english_and_the_language_ends(calibration):
    before = result_json(calibration)
    with language("de"):
        assert result_json(calibration) == before
        assert current() == "de"
    assert current() == "en" and tr("Verdict") == "Verdict"


def test_names_from_the_source_are_not_translated():
    """Points called like words of the report keep their names."""
    n = ring(control=3)
    words = ("points", "rejected", "Verdict", "check", "image", "fixed", "none", "held")
    n = replace(n, points=replace(n.points, labels=tuple(f"{words[i % 8]}{'' if i < 8 else i}" for i in range(len(n.points.labels)))))
    analysis = analyse(baarda.adjust(n))
    with language("de"):
        section = next(s for s in page.sections(analysis) if s.id == "points")
    table = next(b for b in section.blocks if isinstance(b, DataTable) and b.caption == "Alle Punkte")
    assert {row[0] for row in table.rows} >= set(words)


def test_joined_texts_are_translated_part_by_part():
    columns = (Column("decision", "", "", "left"), Column("point", "", "", "left"))
    note = "Correlations and the 95 % ellipsoids are in tables/points.csv. Something else: 3. All points"
    made = Section("x", "Verdict", (DataTable("All points", columns, ((Cell("rejected", "bad"), "rejected"),), note),))
    with language("de"):
        out = translated(made)
    table = out.blocks[0]
    assert out.title == "Urteil" and table.caption == "Alle Punkte"
    assert table.rows[0] == (Cell("verworfen", "bad"), "rejected")
    assert table.note == "Korrelationen und die 95-%-Ellipsoide stehen in tables/points.csv. Something else: 3. Alle Punkte"
    assert translated(made) is made


def test_unknown_text_stays_english():
    with language("de"):
        assert tr("a text that nobody translated") == "a text that nobody translated"
        assert say("{a} of them", a=3) == "3 of them"


def test_unknown_language_is_refused():
    with pytest.raises(UsageError, match="--language is en or de"), language("xx"):
        pass
    run = CliRunner().invoke(app, ["demo", "--language", "xx", "--json"])
    assert run.exit_code == 2 and "--language is en or de, not 'xx'" in run.output


@pytest.mark.parametrize(
    ("text", "line"),
    [('msgid "a"\nmsgstr b', 2), ('"loose"', 1), ('msgctxt "x"', 1), ('msgstr "first"', 1), ('msgid "open', 1)],
)
def test_broken_catalogues_are_named(text, line):
    with pytest.raises(InputError, match=rf"xx.po, line {line}") as found:
        parse_catalogue(text, "xx.po")
    assert found.value.line == line


def test_catalogue_with_escapes_comments_and_repetition():
    assert parse_catalogue('# note\nmsgid ""\n"a\\n"\n"\\"b\\""\nmsgstr "c\\\\"\n\nmsgid "d"\nmsgstr ""\n') == {'a\n"b"': "c\\"}
    with pytest.raises(InputError, match="twice"):
        parse_catalogue('msgid "a"\nmsgstr "b"\nmsgid "a"\nmsgstr "c"\n', "xx.po")


@pytest.fixture(scope="module")
def german_reports(camcal, tmp_path_factory):
    """The folders of the other verbs, in English and in German, and what the verbs say."""
    from baarda.formats.project import write

    base = tmp_path_factory.mktemp("verbs")
    network = ring(4, points=20, control=4)
    for name in ("one", "two"):
        write(network if name == "one" else ring(4, points=20, control=4, noise=0.2), base / name)
    table = base / "v.csv"
    values = np.random.default_rng(3).laplace(size=90)
    table.write_text("residual,image\n" + "".join(f"{v!r},{i % 3}\n" for i, v in enumerate(values.tolist())), encoding="utf-8")
    calls = {
        "residuals": ["residuals", str(table), "--replicas", "99"],
        "compare": ["compare", str(base / "one"), str(base / "two")],
        "simulate": ["simulate", str(base / "one"), "--replicas", "4"],
    }
    made = {}
    for verb, call in calls.items():
        for code in LANGUAGES:
            out = base / f"{verb}-{code}"
            run = CliRunner().invoke(app, [*call, "--out", str(out), "--language", code])
            assert run.exit_code == 0, run.output
            made[verb, code] = out, run.stdout
    return made


@pytest.mark.parametrize("verb", ["residuals", "compare", "simulate"])
def test_other_verbs_speak_german_and_their_json_english(german_reports, verb):
    (english, said), (german, gesagt) = german_reports[verb, "en"], german_reports[verb, "de"]
    assert '<html lang="de">' in (german / "report.html").read_text(encoding="utf-8")
    assert (german / "result.json").read_bytes() == (english / "result.json").read_bytes()
    numbers = re.compile(r"\d+\.\d+")
    lines, zeilen = said.splitlines(), gesagt.splitlines()
    assert len(lines) == len(zeilen) >= 3
    for line, zeile in zip(lines, zeilen, strict=True):
        assert line != zeile and sorted(numbers.findall(line)) == sorted(numbers.findall(zeile)), (line, zeile)


@pytest.mark.parametrize("verb", ["residuals", "compare", "simulate"])
def test_no_english_sentence_is_left_in_their_pages(german_reports, verb):
    """No piece of text between two stops holds two of the words that German never has; paths may."""
    page_text = (german_reports[verb, "de"][0] / "report.html").read_text(encoding="utf-8")
    body = re.sub(r"<(style|script|svg).*?</\1>|<[^>]*>", " ", page_text, flags=re.DOTALL)
    left = [s.strip() for s in re.split(r"[.;:\n]", body) if len(re.findall(r"\b(the|of|is|are|with|and)\b", s)) >= 2]
    assert not [s for s in left if "verbs0" not in s]
