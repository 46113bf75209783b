"""The commands that documents show in fenced `console` blocks, with the output that they show."""

from __future__ import annotations

import re
import textwrap
from dataclasses import dataclass

from docs.website.pages import GENERATED
from tests.paths import ROOT

_NUMBER = re.compile(r"\d[\d.]*")
_BLOCK = re.compile(r"^ *```console\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
_STATUS = re.compile(r"\s+# exit status (\d+)$")


@dataclass(frozen=True, slots=True)
class Shown:
    """A command as a document shows it."""

    command: str
    status: int  # 0, unless the line ends with a comment such as `# exit status 4`
    output: tuple[str, ...]  # the lines below it; `...` stands for any lines


def commands_in(text: str) -> list[Shown]:
    """The commands of a document in their order. A backslash at the end of a line continues a command."""
    out = []
    for match in _BLOCK.finditer(text):
        lines = textwrap.dedent(match[1]).replace("\\\n", "").splitlines()
        for line in lines:
            if line.startswith("$ "):
                status = _STATUS.search(line)
                out.append(Shown(_STATUS.sub("", line[2:]), int(status[1]) if status else 0, ()))
            elif out:
                out[-1] = Shown(out[-1].command, out[-1].status, (*out[-1].output, line))
    return out


def pages() -> dict[str, str]:
    """Name and text of every document with commands: README.md, all pages of docs/, the generated pages."""
    documents = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    texts = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in documents}
    return texts | {name: page() for name, page in GENERATED.items()}


def indented_commands(text: str) -> list[str]:
    """The commands of this program in indented blocks, as README.md has them, without the comments behind them."""
    return [line.split("  #")[0].strip() for line in re.findall(r"^ {4}(beampose .+)$", text, re.MULTILINE)]


def is_shown(line: str, printed: list[str]) -> bool:
    """Whether a line that a document shows was printed; its numbers may differ as they do between processors."""
    words, numbers = _NUMBER.sub("#", line).strip(), _NUMBER.findall(line)
    return any(
        _NUMBER.sub("#", other).strip() == words and all(map(_alike, numbers, _NUMBER.findall(other)))
        for other in printed
    )


def _alike(shown: str, printed: str) -> bool:
    """Whether two numbers differ by a fifth, or one unit of the last digit that is shown, at most."""
    one, other = (float(n.rstrip(".")) if n.count(".") < 2 else n for n in (shown, printed))
    if isinstance(one, str) or isinstance(other, str):  # versions
        return True
    unit = 10.0 ** -len(shown.rstrip(".").partition(".")[2])
    return abs(one - other) <= max(0.2 * max(one, other), 1.001 * unit)
