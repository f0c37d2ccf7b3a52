"""One notebook as a page: text, pictures, films and formulas as HTML that needs no script and no network."""

import base64
import html
import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import nbformat
from latex2mathml.converter import convert
from nbconvert.filters import Highlight2HTML, ansi2html
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from PIL import Image

from suite.findings import Claim, Record
from suite.staleness import number_of

_EMBEDDED = re.compile(r'data:(?:image|video)/([\w+]+);base64,([^"]+)')
_PICTURE = re.compile(r"<(?:video|img)\b[^<]*(?:</video>)?\s*")
_SENTENCE = re.compile(r"(?<=[.!?])\s+(?=[A-Z*$])")
_HIGHLIGHT = Highlight2HTML(pygments_lexer="ipython3")
_SHORT = 60  # characters: a first sentence such as "No." needs the next one


class Picture(NamedTuple):
    """A picture or film that a notebook stores: its file and that of its first frame, relative to the report."""

    file: str
    still: str
    size: tuple[int, int]
    caption: str = ""

    @property
    def film(self) -> bool:
        """It is a video."""
        return self.file.endswith(".mp4")

    @property
    def alt(self) -> str:
        """What it shows, in the first sentence of its caption."""
        return re.sub(r"[*`$]", "", _SENTENCE.split(self.caption.strip())[0])


class Check(NamedTuple):
    """What today's run says: "good", "bad" or "" (nothing), a sentence, details, how many findings agree."""

    mark: str
    said: str
    details: tuple[str, ...] = ()
    agree: int = 0


@dataclass
class Page:
    """A notebook in the report; question, answer, the points that its first cell makes in bold, and body are HTML.

    picture: for its card, the first film, else the first. What the report adds: the record, what today's run says, the
    data that its numbers need, its claims with their verdicts.
    """

    name: str
    number: str
    title: str
    question: str
    answer: str
    points: list[str]
    pictures: list[Picture]
    picture: Picture | None
    body: str
    record: Record | None = None
    check: Check | None = None
    needs: str = ""
    claims: Sequence[tuple[Claim, str]] = ()


def read(notebook: Path, out: Path) -> Page:
    """Reads a notebook with its stored outputs; writes its pictures and films into ``out``/media."""
    (out / "media").mkdir(parents=True, exist_ok=True)
    book, number, numbers = nbformat.read(notebook, as_version=4), number_of(notebook.stem), itertools.count(1)

    def keep(embedded: re.Match[str]) -> str:
        """Write what is embedded, and name the file."""
        file = f"media/{number}-{next(numbers)}.{embedded[1]}"
        (out / file).write_bytes(base64.b64decode(embedded[2]))
        return file

    pictures, body, code = [], [], ""  # code that showed nothing yet: folded together with what follows
    for cell in (*book.cells, nbformat.v4.new_markdown_cell("")):
        if cell.cell_type == "code":
            code += _HIGHLIGHT(cell.source)
            if not cell.outputs:
                continue
        if code:
            body.append(f"<details class='code'><summary>Code</summary>{code}</details>")
            code = ""
        if cell.cell_type == "markdown":
            body.append(markdown(cell.source))
        for each in _shown(cell.get("outputs", ()), keep, out):
            pictures += [each] if isinstance(each, Picture) else []
            body.append(_figure(each) if isinstance(each, Picture) else each)
    first = next((cell.source for cell in book.cells if cell.cell_type == "markdown"), "")
    answer = _said(first, "Answer")
    points = re.findall(r"^- \*\*(.+?)\*\*", answer, re.MULTILINE)
    opening, *more = _SENTENCE.split(answer)
    title = re.match(r"# (?:\S+ · )?(.*)", first)
    return Page(
        name=notebook.stem, number=number, title=title[1] if title else notebook.stem,
        question=_inline(_said(first, "Question")), points=list(map(_inline, points)),
        answer=_inline(" ".join([opening, *more[: len(opening) <= _SHORT]])),
        pictures=pictures, picture=min(pictures, key=lambda each: not each.film, default=None),
        body=re.sub(r'\.ipynb(?=["#])', ".html", "\n".join(body)),  # links to other notebooks
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------- text
class _Renderer(IPythonRenderer):
    """Formulas as MathML; tables that scroll by themselves where the page is narrow."""

    def block_math(self, body: str) -> str:
        return f"<div class='formula' tabindex='0'>{_formula(body, 'block')}</div>"

    def inline_math(self, body: str) -> str:
        return _formula(body, "inline")

    def table(self, text: str) -> str:
        return f"<div class='wide' tabindex='0'><table>{text}</table></div>\n"


def _formula(tex: str, display: str) -> str:
    """MathML of a formula as browsers draw it: script and upright letters, a space behind a function's name."""
    found = convert(re.sub(r"\\mathcal\s+(\w)", r"\\mathcal{\1}", tex.strip()), display=display)
    found = re.sub(r"<mi>(&#x000[4-7][0-9A-F];)</mi>", r"<mi mathvariant='normal'>\1</mi>", found)
    return re.sub(r"(<mi>(?:log|exp|sin|cos)</mi>)(?=<mi>)", r"\1<mspace width='0.167em'/>", found)


def markdown(text: str) -> str:
    """Converts Markdown with formulas to HTML with MathML."""
    found = MarkdownWithMath(renderer=_Renderer(escape=False, anchor_link_text="#")).render(text)
    return re.sub(r"<p>(<div class='formula'.*?</div>)\s*</p>", r"\1", found)  # no paragraph holds a block


def _inline(text: str) -> str:
    return markdown(text).strip().removeprefix("<p>").removesuffix("</p>")


def _said(text: str, head: str) -> str:
    """The paragraph, and a list right below it, that begins with this word in bold."""
    found = re.search(rf"^\*\*{head}\.\*\*\s*(.+?)(?=\n\n(?!- )|\Z)", text, re.MULTILINE | re.DOTALL)
    return found[1] if found else ""


# ------------------------------------------------------------------------------------------------------------- outputs
def _shown(outputs: list, keep: Callable[[re.Match[str]], str], out: Path) -> list[Picture | str]:
    """The outputs of a cell, HTML where they are no pictures; a picture takes the caption that follows it."""
    shown: list[Picture | str] = []
    for output in outputs:
        data = output.get("data", {})
        text, embedded = data.get("text/markdown", ""), data.get("text/html", "").strip()
        if "image/png" in data:
            embedded = f'<img src="data:image/png;base64,{data["image/png"]}">'
        if text.startswith("**Figure") and shown and isinstance(shown[-1], Picture):
            shown[-1] = shown[-1]._replace(caption=text)
        elif text:
            shown.append(markdown(text))
        elif embedded and _PICTURE.fullmatch(embedded):
            files = [keep(each) for each in _EMBEDDED.finditer(embedded)]
            still = next(file for file in files if not file.endswith(".mp4"))
            with Image.open(out / still) as image:
                shown.append(Picture(max(files, key=lambda file: file.endswith(".mp4")), still, image.size))
        elif embedded:
            shown.append(_EMBEDDED.sub(keep, embedded))
        else:
            plain = output.get("text") or "\n".join(output.get("traceback", ())) or data.get("text/plain", "")
            shown.append(f"<pre>{ansi2html(plain)}</pre>")
    return shown


def _figure(picture: Picture) -> str:
    alt = html.escape(picture.alt or "A picture; the text beside it says what it shows.")
    size = "width='{}' height='{}'".format(*picture.size)
    if picture.film:
        how = "controls loop autoplay muted playsinline preload='metadata'"
        shown = f"<video {how} {size} poster='{picture.still}' src='{picture.file}' aria-label='{alt}'></video>"
    else:
        shown = f"<img {size} src='{picture.file}' alt='{alt}' loading='lazy'>"
    return f"<figure>{shown}<figcaption>{markdown(picture.caption)}</figcaption></figure>"
