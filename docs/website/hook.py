"""The hook of mkdocs.yml: adds the generated pages, expands the navigation, renders formulas, forbids the network."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
if str(ROOT) not in sys.path:  # MkDocs loads this file by its path
    sys.path.insert(0, str(ROOT))

# After the path is set.
from docs.website import gallery  # noqa: E402
from docs.website.formulas import FormulaError, with_mathml  # noqa: E402
from docs.website.navigation import expanded  # noqa: E402
from docs.website.network import network_addresses  # noqa: E402
from docs.website.pages import GENERATED  # noqa: E402
from docs.website.study_tables import with_tables  # noqa: E402
from docs.website.validation import with_comparisons  # noqa: E402

_LOG = logging.getLogger("mkdocs.hooks.beampose")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Replace patterns such as `papers/*.md` in the navigation by the files that match them."""
    if config.nav is not None:
        config.nav = expanded(config.nav, Path(config.docs_dir), [f"gallery/{name}.md" for name in gallery.names()])
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are generated from the code, and the gallery, made again if the program has changed."""
    for path, page in GENERATED.items():
        files.append(File.generated(config, path, content=page()))
    for made in sorted(gallery.build().iterdir()):
        if made.suffix != "":
            files.append(File.generated(config, f"gallery/{made.name}", abs_src_path=str(made)))
    return files


def on_page_markdown(markdown: str, page: Any, config: MkDocsConfig, files: Files) -> str:
    """Put tables and figures that are kept as CSV into their pages."""
    return with_comparisons(with_tables(markdown))


def on_page_content(html: str, page: Any, config: MkDocsConfig, files: Files) -> str:
    """Render the formulas of a page as MathML."""
    try:
        return with_mathml(html)
    except FormulaError as error:
        raise PluginError(f"{page.file.src_uri}: {error}") from None


def on_post_build(config: MkDocsConfig) -> None:
    """Stop the build if a page would load anything from the network."""
    site = Path(config.site_dir)
    found = [
        f"{path.relative_to(site)}: {address}"
        for path in sorted(site.rglob("*.html"))
        for address in network_addresses(path.read_text(encoding="utf-8"))
    ]
    if found:
        raise PluginError("pages load from the network, so the site does not work offline:\n" + "\n".join(found))
    _LOG.info("no page loads anything from the network")
