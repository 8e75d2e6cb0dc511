"""Documents outside ``docs`` as pages of the site, and the files that pages link to.

Links are written for a reader of the repository. Here a link that leaves ``docs`` becomes a link to
the page of that document or, for any other file (a picture, a result), to a copy of it.
"""

import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
PAGES = {
    "CONTRIBUTING.md": "contributing.md",
    "DECISIONS.md": "decisions.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "README.md": "index.md",
    "calibration_artifacts/README.md": "demonstration-bundles.md",
    "bench/results/README.md": "result-files.md",
    "deploy/README.md": "deploy.md",
    "ros/README.md": "ros.md",
}
COPIES = "repository"
_LINK = re.compile(r"(\]\()([^)#\s]+)((?:#[^)\s]*)?\))")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the documents outside ``docs`` as pages, and a copy of each other file linked to."""
    for document, page in PAGES.items():
        if page != "index.md":
            files.append(File.generated(config, page, content=(ROOT / document).read_text("utf-8")))
    for file in list(files.documentation_pages()):
        for _, link, _ in _LINK.findall(file.content_string):
            copy = _in_site(link, file.src_uri)
            if copy.startswith(f"{COPIES}/") and copy not in files.src_uris:
                path = ROOT / copy.removeprefix(f"{COPIES}/")
                files.append(File.generated(config, copy, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Rewrite the links of a page."""
    here = page.file.src_uri

    def rewritten(match: re.Match[str]) -> str:
        there = _in_site(match[2], here)
        if not there:
            return match[0]
        return match[1] + os.path.relpath(there, Path(here).parent).replace(os.sep, "/") + match[3]

    return _LINK.sub(rewritten, markdown)


def _in_site(link: str, page: str) -> str:
    """Where the target of a link is in the site, "" for an address or a file that is not there."""
    if "://" in link or link.startswith("mailto:"):
        return ""
    documents = {target: source for source, target in PAGES.items() if target != "index.md"}
    source = ROOT / documents.get(page, f"docs/{page}")
    target = Path(os.path.normpath(source.parent / link))
    if not target.is_file():
        return ""
    relative = target.relative_to(ROOT).as_posix()
    if relative in PAGES:
        return PAGES[relative]
    if relative.startswith("docs/"):
        return relative.removeprefix("docs/")
    return f"{COPIES}/{relative}"
