"""Pages that show a file which is no page, or what is in a folder."""

from pathlib import Path

from pages.links import files_of

_LANGUAGES = {".c": "c", ".py": "python", ".toml": "toml"}


def shown(path: Path) -> str:
    """Return a page with the text of a file."""
    text = path.read_text()
    fence = "````" if "```" in text else "```"
    return f"# {path.name}\n\n{fence}{_LANGUAGES.get(path.suffix, 'text')}\n{text}{fence}\n"


def listing(folder: Path) -> str:
    """Return a page with links to the files in a folder."""
    names = [file.relative_to(folder).as_posix() for file in files_of(folder)]
    return f"# {folder.name}\n\n" + "".join(f"- [{n}]({folder.name}/{n})\n" for n in names)
