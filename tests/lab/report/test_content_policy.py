"""Reports load nothing from outside, and run only the scripts of their templates."""

from __future__ import annotations

import base64
import hashlib
import re

import pytest

from lab.report.page import content_policy, environment, scripts

TEMPLATES = sorted(n for n in environment().list_templates() if n.endswith(".html.j2") and n != "sections.html.j2")


def source_of(name):
    return environment().loader.get_source(environment(), name)[0]


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_page_states_its_policy_before_anything_else_but_the_character_set(name):
    source = source_of(name)
    head = source[source.index("<head>") :].splitlines()
    assert head[1] == '<meta charset="utf-8">'
    policy = re.fullmatch(r'<meta http-equiv="Content-Security-Policy" content="(.*)">', head[2])[1]
    assert "script-src 'unsafe-inline'" not in policy
    served = f'{{{{ content_policy("{name}", True) }}}}'  # it may load from the server that it comes from
    assert policy in (served, f'{{{{ content_policy("{name}") }}}}') or policy.startswith("default-src 'none'; ")


@pytest.mark.parametrize("name", [n for n in TEMPLATES if "content_policy(" in source_of(n)])
def test_every_script_is_allowed_by_its_hash_and_has_no_expression(name):
    policy = content_policy(environment(), name)
    assert policy.startswith("default-src 'none'; ")
    assert "script-src 'unsafe-inline'" not in policy
    for text in scripts(environment(), name):
        assert "{{" not in text, "data belongs into attributes or into a script of type application/json"
        shown = environment().from_string(f"<script>{text}</script>\n").render()
        inner = re.search(r"<script>(.*)</script>", shown, re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(inner.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy


@pytest.mark.parametrize("name", TEMPLATES)
def test_no_page_has_a_handler_in_an_attribute_which_the_policy_would_block(name):
    assert not re.search(r"<[^>]+\son[a-z]+=", source_of(name))
