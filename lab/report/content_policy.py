"""The content security policy of the reports: they load nothing, and run only the scripts of their own template."""

from __future__ import annotations

import base64
import hashlib
import re

import jinja2

_INCLUDE = re.compile(r"{%-?\s*include\s+[\"']([^\"']+)[\"']\s*-?%}")
_END = "//end"  # Jinja drops a line break at the end of a template, which is not the end of a script
_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL | re.IGNORECASE)


def content_policy(environment: jinja2.Environment, template: str) -> str:
    """The policy of one template, for its `<meta http-equiv="Content-Security-Policy">`.

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
