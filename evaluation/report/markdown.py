"""Tables and lists in Markdown."""

from collections.abc import Iterable

from kouxing.evaluation.tables import Table


def markdown(table: Table) -> str:
    """Return a table in Markdown."""
    lines = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def bullets(sentences: Iterable[str]) -> str:
    """Return a list in Markdown."""
    return "".join(f"- {sentence}\n" for sentence in sentences)
