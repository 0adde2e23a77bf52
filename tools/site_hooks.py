"""MkDocs's hooks: pages keep their places in the repository, and bring along what they link to.

In the site each page is known by its path from the repository's root, so that links which work on GitHub,
such as `../recipes/results/x.png` or `../SECURITY.md`, lead to the same files here. Pages of `docs/` have
addresses without that folder; everything else lies under `repository/`. Notebooks become pages, with what
their cells printed and drew when they were last run.
"""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page
from pages.command_line import command_line
from pages.links import linked
from pages.notebooks import notebook_page
from pages.python_names import python_names
from pages.recipe_keys import recipe_keys
from pages.sources import listing, shown

ROOT = Path(__file__).parents[1]
DOCS = "docs/"
GENERATED = {
    "docs/reference/recipe_keys.md": recipe_keys,
    "docs/reference/command_line.md": command_line,
    "docs/reference/python.md": python_names,
}
"""Pages of the reference, and what writes them anew for each build."""
BOOSTS = {"docs/guide/": 4, "docs/results/": 0.25, "docs/": 1}
"""How far up a search lists pages, by their folder; pages in none of these are not searched."""
PICTURES = {".gif", ".jpg", ".png", ".svg"}


class RepositoryFile(File):
    """A file of the repository, named by its path from there; pictures are copied, all others are pages."""

    def is_documentation_page(self) -> bool:
        """Tell whether this becomes a page."""
        return Path(self.src_uri).suffix not in PICTURES

    @property
    def edit_uri(self) -> str | None:
        """The path to edit it at; None for what is in no file."""
        return None if self.src_uri in GENERATED or (ROOT / self.src_uri).is_dir() else self.src_uri


def on_config(config: MkDocsConfig) -> None:
    """Let pages lead to where they are edited, from the repository's root, if its address is known."""
    if config.repo_url:
        config.edit_uri = "edit/main/"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Rename the pages of `docs/`, and add the reference and all that pages link to."""
    in_nav = [name for name in _names(config.nav) if name not in GENERATED]
    pages = [DOCS + page.src_uri for page in files.documentation_pages()]
    for page in files.documentation_pages():
        files.remove(page)
    for name, write in GENERATED.items():
        files.append(_file(name, write(), config))
    for name in linked(ROOT, [*pages, *in_nav]):
        file = _file(name, _content(name), config)
        if name not in pages:
            file.inclusion = InclusionLevel.NOT_IN_NAV
        files.append(file)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let a search find guides before results, and no sources."""
    boost = next((boost for folder, boost in BOOSTS.items() if page.file.src_uri.startswith(folder)), None)
    page.meta["search"] = {"exclude": True} if boost is None else {"boost": boost}
    return markdown


def _names(nav: object) -> list[str]:
    """Return the paths that a part of the navigation names."""
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav if isinstance(nav, list) else []
    return [name for part in parts for name in _names(part)]


def _content(name: str) -> str | bytes:
    path = ROOT / name
    if path.is_dir():
        return listing(path)
    if path.suffix == ".ipynb":
        return notebook_page(path)
    if path.suffix in PICTURES:
        return path.read_bytes()
    return path.read_text() if path.suffix == ".md" else shown(path)


def _file(name: str, content: str | bytes, config: MkDocsConfig) -> File:
    file = RepositoryFile.generated(config, name, content=content)
    place = name.removeprefix(DOCS) if name.startswith(DOCS) else f"repository/{name}"
    if file.is_documentation_page():
        place = f"{place.removesuffix('.md').removesuffix('.ipynb')}/index.html"
    file.dest_uri = "index.html" if place == "index/index.html" else place
    return file
