"""The environment of the HTML templates: kept compiled, with a security policy that loads nothing."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import re
from functools import cache
from importlib import metadata
from pathlib import Path

import jinja2
from jinja2.bccache import Bucket
from markupsafe import Markup, escape

from geometry.compilation.compile_cache import private_folder

# The content security policy of the reports: they load nothing, and run only the scripts of their own template.

_INCLUDE = re.compile(r"{%-?\s*include\s+[\"']([^\"']+)[\"']\s*-?%}")
_END = "//end"  # Jinja drops a line break at the end of a template, which is not the end of a script
_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL | re.IGNORECASE)


def content_policy(environment: jinja2.Environment, template: str, served: bool = False) -> str:
    """The policy of one template, for its `<meta http-equiv="Content-Security-Policy">`.

    served: the page may load from the server that it comes from.

    The inline scripts are allowed by their hashes, computed from the template and not from the page: a script that
    gets into the page by its data does not run. Scripts of templates therefore have no Jinja expressions: data is
    in attributes, or in `<script type="application/json">`, which does not run.
    """
    hashes = [
        f"'sha256-{_hash(environment.from_string(text + _END).render().removesuffix(_END))}'"
        for text in scripts(environment, template)
    ]
    return "; ".join(
        (
            "default-src 'none'",
            "style-src 'unsafe-inline'",
            "img-src data:",
            f"script-src {' '.join(hashes) or chr(39) + 'none' + chr(39)}",
            *(("connect-src 'self'",) if served else ()),
            "base-uri 'none'",
            "form-action 'none'",
        )
    )


def scripts(environment: jinja2.Environment, template: str) -> list[str]:
    """The inline scripts of a template and of those that it includes, as written there."""
    assert environment.loader is not None
    source = environment.loader.get_source(environment, template)[0]
    inner = [n for n in _INCLUDE.findall(_SCRIPT.sub("", source)) if n.endswith(".j2")]
    return _SCRIPT.findall(source) + [text for name in inner for text in scripts(environment, name)]


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")


# Compiled templates kept on disk: to compile those of one report takes 0.05 s.


class _TemplateCache(jinja2.FileSystemBytecodeCache):
    """Jinja's cache, for which a file that cannot be read or written is a missing one."""

    def load_bytecode(self, bucket: Bucket) -> None:
        try:
            super().load_bytecode(bucket)
        except Exception:  # unpickling a truncated file raises almost anything
            bucket.reset()

    def dump_bytecode(self, bucket: Bucket) -> None:
        with contextlib.suppress(OSError):  # for instance a full disk
            super().dump_bytecode(bucket)


def template_cache(sources: tuple[Path, ...]) -> jinja2.BytecodeCache | None:
    """Where templates are kept that were compiled from these files; None where no folder can be written safely."""
    folder = private_folder(sources)
    if folder is None:
        return None
    return _TemplateCache(str(folder), f"%s-{metadata.version('jinja2')}.template")


# The template engine of all reports: each is one self-contained HTML file.


TEMPLATES = Path(__file__).parent / "templates"


@cache
def environment() -> jinja2.Environment:
    """The templates in lab/report/templates/; text that is not marked as HTML is escaped."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        bytecode_cache=template_cache((Path(__file__), *sorted(TEMPLATES.iterdir()))),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["words"] = words
    made.globals["content_policy"] = lambda template, served=False: content_policy(made, template, served)
    return made


def words(text: str) -> Markup:
    """A message as HTML: what the command line shows between backticks is code here."""
    return Markup(re.sub(r"`([^`\n]+)`", r"<code>\1</code>", str(escape(text))))


def as_script(data: object) -> Markup:
    """Data for a script element of type application/json."""
    return Markup(json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"))
