"""The directive ``results``: what an expression of results_tables.py returns, in a page without code of its own.

    ```{results} table("ablations-hartley")
    :fold: better than Hartley %
    ```

The option ``fold`` hides it behind a title. Sphinx evaluates the expression itself, so a page needs no kernel for it.
"""

from __future__ import annotations

import html
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from IPython.display import HTML
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class Results(SphinxDirective):
    """Show a table or a plot of the numbers in docs/results."""

    optional_arguments = 1
    final_argument_whitespace = True
    has_content = True
    option_spec: ClassVar = {"fold": directives.unchanged_required}

    def run(self) -> list[nodes.Node]:
        """Return the nodes of the table, Markdown, or of the plot, SVG."""
        import results_tables

        shown = eval(" ".join([*self.arguments, *self.content]), vars(results_tables))
        if isinstance(shown, HTML):
            found: list[nodes.Node] = [nodes.raw("", shown.data, format="html")]
        else:
            found = self.parse_text_to_nodes(shown.data)
        if "fold" in self.options:
            title = html.escape(self.options["fold"])
            before = f'<details class="fold"><summary>Table: {title}</summary>'
            found = [nodes.raw("", before, format="html"), *found, nodes.raw("", "</details>", format="html")]
        return found


def setup(app: Sphinx) -> dict[str, Any]:
    """Add the directive."""
    app.add_directive("results", Results)
    return {"parallel_read_safe": True}
