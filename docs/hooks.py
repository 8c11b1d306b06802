"""What MkDocs shows beside the pages in this folder, and how it reads our docstrings."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import griffe
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
OUTSIDE = ("CHANGELOG.md", "CONTRIBUTING.md", "benchmarks/NOTES.md", "benchmarks/report/*", "examples/*.*")
"""Files of the repository that are pages, pictures and scripts of the site too."""


def on_files(files: Files, config: Any) -> Files:
    """Adds the files that live outside of the folder of the pages, under their path in the repository."""
    for pattern in OUTSIDE:
        for path in sorted(ROOT.glob(pattern)):
            files.append(File.generated(config, str(path.relative_to(ROOT)), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Makes links that hold in the repository hold in the site, whose root is ``docs``."""
    if "/" in page.file.src_uri:
        return markdown
    outside = page.file.src_uri in OUTSIDE
    return markdown.replace("](docs/", "](") if outside else markdown.replace("](../", "](")


class PlainRoles(griffe.Extension):
    """Shows Sphinx's roles in docstrings, such as ``:class:`~package.Name```, as the name alone."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrites the docstring of an object."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", obj.docstring.value)
