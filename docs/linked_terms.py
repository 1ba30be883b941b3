"""Links the first use of each of the glossary's terms on a page to what the glossary says of it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.transforms.post_transforms import SphinxPostTransform

UNLINKED = (
    nodes.title,
    nodes.reference,
    nodes.literal,
    nodes.FixedTextElement,
    nodes.math,
    nodes.term,
    nodes.raw,
    addnodes.desc,
)
PAGES = "glossary", "reference", "genindex"
"""Where a word means itself, or where docstrings speak to those who know."""
EVERYDAY = "cell", "frame", "match"
"""Terms that pages use in their everyday sense, too."""


class LinkedTerms(SphinxPostTransform):
    """After all other references are resolved, as these need no resolving: the glossary's places are known."""

    default_priority = 900

    def run(self, **_: Any) -> None:
        page = self.env.docname
        if page in PAGES or page.startswith("examples/"):
            return
        places = {
            name: (at, label)
            for (kind, name), (at, label) in self._objects()
            if kind == "term" and name not in EVERYDAY
        }
        wanted = {name: re.compile(rf"\b{re.escape(name)}(s|es)?\b", re.IGNORECASE) for name in places}
        for text in list(self.document.findall(nodes.Text)):
            if not any(isinstance(parent, UNLINKED) for parent in _parents(text)):
                found = [(match, name) for name, pattern in wanted.items() if (match := pattern.search(text))]
                taken = 0
                parts: list[nodes.Node] = []
                for match, name in sorted(found, key=lambda one: (one[0].start(), -len(one[1]))):
                    if match.start() >= taken:
                        parts.append(nodes.Text(text[taken : match.start()]))
                        parts.append(self._link(page, *places[name], match.group()))
                        taken = match.end()
                        del wanted[name]
                if parts:
                    text.parent.replace(text, [*parts, nodes.Text(text[taken:])])

    def _objects(self) -> Iterator[Any]:
        return iter(self.env.domains.standard_domain.objects.items())

    def _link(self, page: str, at: str, label: str, word: str) -> nodes.Node:
        target = f"{self.app.builder.get_relative_uri(page, at)}#{label}"
        return nodes.reference(
            "", "", nodes.inline("", word, classes=["std", "std-term"]), internal=True, refuri=target
        )


def _parents(node: nodes.Node) -> Iterator[nodes.Node]:
    while node.parent is not None:
        node = node.parent
        yield node


def setup(app: Any) -> dict[str, Any]:
    app.add_post_transform(LinkedTerms)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
