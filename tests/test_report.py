"""The report: what it links to is there, it needs no network, and its formulas and pictures come through."""

import base64
import io
import math
import re
from pathlib import Path

import nbformat
import pytest
from PIL import Image

from suite import findings, page, report


def tags(text):
    """(name, attributes) of every tag of a page."""
    for name, rest in re.findall(r"<(\w+)([^>]*)>", text):
        yield name, {key: value for key, _, value in re.findall(r"""([\w-]+)=(["'])(.*?)\2""", rest, re.DOTALL)}


def problems(folder):
    """What a browser without a network would miss, a phrase each."""
    pages = {path.name: path.read_text(encoding="utf-8") for path in folder.glob("*.html")}
    places = {name: {given.get("id") for _, given in tags(text)} for name, text in pages.items()}
    for name, tag, given in ((name, *each) for name, text in pages.items() for each in tags(text)):
        loads = ("src", "poster", "srcset", "data", *(["href"] if tag == "link" else []))
        for target in filter(None, map(given.get, loads)):
            if re.match(r"(?:https?:)?//", target):
                yield f"{name} loads {target}"
            elif not target.startswith("data:") and not (folder / target).is_file():
                yield f"{name}: no file {target}"
        target = given.get("href", "") if tag == "a" else ""
        file, _, anchor = target.partition("#")
        if target and not re.match(r"https?://|mailto:", target):  # no paper
            if not (folder / (file or name)).is_file():
                yield f"{name}: no page {target}"
            elif anchor and anchor not in places[file or name]:
                yield f"{name}: no place {target}"
        if (tag == "img" and not given.get("alt")) or (tag == "video" and not given.get("aria-label")):
            yield f"{name} shows without a description: {given}"
    formulas = [each for text in pages.values() for each in re.findall(r"<math.*?</math>", text, re.DOTALL)]
    yield from (f"TeX in a formula: {each}" for each in formulas if "\\" in re.sub(r"<[^>]*>", "", each))
    for path in folder.rglob("*.css"):
        yield from (f"{path.name} loads {each}" for each in re.findall(r"@import.*|url\(.*?\)", path.read_text()))


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    return out, report.build(out)


def test_the_report_needs_nothing_but_its_folder(built):
    out, entries = built
    found = list(problems(out))
    assert not found, "\n".join(found)
    assert {f"{entry.name}.html" for entry in entries} < {path.name for path in out.glob("*.html")}


def test_every_notebook_has_a_card_and_no_row_is_not_a_number(built):
    out, entries = built
    index = (out / "index.html").read_text(encoding="utf-8")
    assert index.count('<article class="card">') == len(entries) and "<video autoplay" in index
    assert all(entry.question and entry.answer and entry.picture for entry in entries)
    tests = (out / "tests.html").read_text(encoding="utf-8")
    assert not re.search(r"\b(nan|None)\b", tests)
    nothing = math.nan, math.nan, math.nan, 0
    row = findings.Finding("H18.a", "synthetic", *nothing, "cm", "mean", ">= 2 cm", "", "07", "full")
    assert report._measured(row) == "not run: nothing to measure"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("<script src='https://cdn.example/x.js'></script>", "loads https"),
        ("<link href='//cdn.example/x.css'>", "loads //"),
        ("<img src='gone.png' alt='x'>", "no file gone.png"),
        ("<img src='there.png'>", "without a description"),
        ("<a href='gone.html'>x</a>", "no page gone.html"),
        ("<a href='#gone'>x</a>", "no place #gone"),
        ("<a href='a.html#gone'>x</a>", "no place a.html#gone"),
        (r"<math><mi>\foo</mi></math>", "TeX in a formula"),
        ("<a href='https://arxiv.org/abs/2105.04668'>a paper</a><a href='a.html#here' id='here'>x</a>", None),
    ],
)
def test_control_a_page_that_lacks_something_is_found(tmp_path, text, complaint):
    (tmp_path / "a.html").write_text(text, encoding="utf-8")
    (tmp_path / "there.png").touch()
    found = list(problems(tmp_path))
    assert complaint in found[0] if complaint else not found


def test_formulas_are_mathml_and_dollars_in_code_stay():
    text = page.markdown(r"A $\mathrm{E}\lVert x_t \rVert$ of $\mathcal N$, `a$b`." + "\n\n" + r"$$\sum_t x_t$$")
    assert text.count("<math") == 3 and "<munder>" in text and "a$b" in text and "<p><div" not in text
    assert "<mi mathvariant='normal'>&#x00045;</mi>" in text and "&#x1D4A9;" in text


def encoded(colour, kind="PNG"):
    file = io.BytesIO()
    Image.new("RGB", (8, 4), colour).save(file, kind)
    return base64.b64encode(file.getvalue()).decode()


def stored(path: Path):
    """A notebook with a plot, a film, code that shows nothing, and an error."""
    new = nbformat.v4
    poster = f'poster="data:image/jpeg;base64,{encoded("red", "JPEG")}"'
    film = f'<video loop {poster} src="data:video/mp4;base64,AAAA"></video>'
    found = "No. It is *not*, as far as anybody could see by looking at it. More follows. See [02](02_other.ipynb)."
    cells = [new.new_markdown_cell(f"# 07 · A title\n\n**Question.** Is it $x$?\n\n**Answer.** {found}")]
    cells += [new.new_code_cell(code) for code in ("quiet = 1", "draw()", "fail()")]
    said = "text/markdown"
    shown = [("image/png", encoded("blue")), (said, "**Figure 07.1.** A $plot$. Twice.")]
    shown += [("text/html", film), (said, "**Figure 07.2.** A film.")]
    cells[2].outputs = [new.new_output("display_data", data={kind: data}) for kind, data in shown]
    cells[3].outputs = [new.new_output("error", ename="E", evalue="x", traceback=["\x1b[31mE\x1b[0m: <x>"])]
    nbformat.write(new.new_notebook(cells=cells), path)
    return path


def test_a_notebook_becomes_a_page_with_its_pictures_as_files(tmp_path):
    found = page.read(stored(tmp_path / "07_toy.ipynb"), tmp_path)
    assert (found.number, found.title) == ("07", "A title") and found.question.startswith("Is it <math")
    assert found.answer == "No. It is <em>not</em>, as far as anybody could see by looking at it."
    plot, film = found.pictures
    assert (plot.file, plot.size, plot.alt) == ("media/07-1.png", (8, 4), "Figure 07.1. A plot.")
    assert (film.still, film.file) == ("media/07-2.jpeg", "media/07-3.mp4") and found.picture == film
    assert (tmp_path / film.file).read_bytes() == b"\0\0\0" and "base64" not in found.body
    assert found.body.count("<details class='code'>") == 2 and "quiet" in found.body  # with the code that follows
    assert "E</span>: &lt;x&gt;" in found.body and 'href="02_other.html"' in found.body
