"""Reports load nothing from outside, and run only the scripts of their templates."""

from __future__ import annotations

import base64
import hashlib
import re

import pytest

from lab.report.content_policy import content_policy, scripts
from lab.report.html import environment

TEMPLATES = sorted(n for n in environment().list_templates() if n.endswith(".html.j2") and n != "sections.html.j2")


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_page_states_its_policy_before_anything_else_but_the_character_set(name):
    source, _, _ = environment().loader.get_source(environment(), name)
    head = source[source.index("<head>") :].splitlines()
    assert head[1] == '<meta charset="utf-8">'
    assert head[2] == f'<meta http-equiv="Content-Security-Policy" content="{{{{ content_policy("{name}") }}}}">'


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_script_is_allowed_by_its_hash_and_has_no_expression_nor_handler(name):
    policy = content_policy(environment(), name)
    assert policy.startswith("default-src 'none'; ")
    assert "script-src 'unsafe-inline'" not in policy
    for text in scripts(environment(), name):
        assert "{{" not in text, "data belongs into attributes or into a script of type application/json"
        shown = environment().from_string(f"<script>{text}</script>\n").render()
        inner = re.search(r"<script>(.*)</script>", shown, re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(inner.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy
    source, _, _ = environment().loader.get_source(environment(), name)
    assert not re.search(r"<[^>]+\son[a-z]+=", source)
    assert len(re.findall(r"<script(?! type=\"application/json\")", source)) == source.count("<script>")
