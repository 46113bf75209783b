"""The pages that are generated when the site is built, by their place in the site."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from docs.website import codes, commands, parameters, yaml_files

GENERATED: Mapping[str, Callable[[], str]] = {
    "reference/parameters.md": parameters.page,
    "reference/commands.md": commands.page,
    "reference/yaml-files.md": yaml_files.page,
    "reference/codes.md": codes.page,
}
