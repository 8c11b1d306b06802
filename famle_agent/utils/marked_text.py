"""Parts of a page that a program writes, between two comments that nobody sees."""

from __future__ import annotations

from pathlib import Path

from famle_agent.utils.atomic_write import whole_file

__all__ = ["write_marked"]


def write_marked(path: Path, name: str, text: str) -> None:
    """Puts a text between ``<!-- name -->`` and ``<!-- /name -->`` of a page, in the place of what is there.

    Args:
        path: The page.
        name: What the part is called.
        text: What stands there from now on.

    Raises:
        ValueError: The page has no such part.
    """
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    before, found, rest = path.read_text().partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise ValueError(f"{path} has no lines {begin} and {end} for the text to stand between.")
    with whole_file(path) as new:
        new.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}")
