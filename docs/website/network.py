"""Finds what a page would load from the network."""

from __future__ import annotations

from html.parser import HTMLParser

_LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "audio": "src"}
_LINKED = {"stylesheet", "icon", "preload", "prefetch", "preconnect", "dns-prefetch", "modulepreload", "manifest"}
_REMOTE = ("http:", "https:", "//")


class _Loads(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        address = values.get(_LOADED.get(tag, ""))
        if tag == "link" and _LINKED & set((values.get("rel") or "").split()):
            address = values.get("href")
        if address and address.strip().lower().startswith(_REMOTE):
            self.addresses.append(address)


def network_addresses(html: str) -> list[str]:
    """Addresses that a browser loads when it shows the page; links that a reader may follow are not among them."""
    parser = _Loads()
    parser.feed(html)
    return parser.addresses
