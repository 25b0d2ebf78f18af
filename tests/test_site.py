"""The documentation as a site: built, opened from disk in a browser, and looked at as a reader would."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
TAGS = re.findall(
    r"\w+",
    "a article aside b body br button circle code dd details div dl dt em figcaption figure footer form g h1 h2 h3 h4 "
    "h5 h6 head header hr html i img input kbd label li line link main meta nav ol option p path polygon polyline pre "
    "rect script small span strong style sub summary sup svg table tbody td text th thead title tr ul use video",
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the site, built where nothing can be fetched."""
    folder = tmp_path_factory.mktemp("site")
    nowhere = {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, **nowhere, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(build, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def built(site: Path) -> Iterator[tuple[Path, str]]:
    """Each page of the site with its HTML."""
    for page in sorted(site.glob("*.html")):
        yield page, page.read_text(encoding="utf-8")


def test_every_page_is_built_and_fetches_nothing(site):
    names = {page.stem for page, _ in built(site)}
    assert {page.stem for page in PAGES} < names
    assert {"commands-evaluation", "configuration-algo", "python-lifelong", "contributing", "changes"} < names
    assert {f"notebook-{path.stem}" for path in ROOT.glob("notebooks/*.ipynb")} < names
    for page, content in built(site):
        assert "<!-- generated" not in content
        fetched = re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?://[^"]+)"', content)
        assert not fetched, f"{page.name} fetches {fetched}"
        if page.name == "404.html":  # its links are from the root of a server
            continue
        for link in re.findall(r'(?:href|src)="(?!https?:|mailto:|data:|#)([^"#?]+)(#[^"]*)?"', content):
            target = (site / link[0]).resolve()
            assert target.exists(), f"{page.name} leads to {link[0]}"
            if link[1] and target.suffix == ".html":
                assert link[1][1:] in anchors(target), f"{page.name}: {''.join(link)}"


@cache
def anchors(page: Path) -> set[str]:
    """What links can point at in a page."""
    return set(re.findall(r'\bid="([^"]+)"', page.read_text(encoding="utf-8")))


class Shown(HTMLParser):
    """The tags of a page, and its text."""

    def __init__(self, content: str):
        super().__init__()
        self.tags, self.text = set(), []
        self.feed(content)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)

    def handle_data(self, data):
        self.text.append(data)


def test_what_stands_in_angle_brackets_is_seen(site):
    """A placeholder such as <algo> that is not escaped is an unknown tag; one that is escaped twice is seen so."""
    for page, content in built(site):
        shown = Shown(content)
        assert not shown.tags.difference(TAGS), f"{page.name}: {shown.tags.difference(TAGS)}"
        assert "&lt;" not in "".join(shown.text), page.name
    reference = "".join(Shown((site / "configuration.html").read_text(encoding="utf-8")).text)
    assert "runs_dir/<benchmark>/<algo>/<policy>_seed<seed>" in reference
    unescaped = Shown("a run is kept in runs_dir/<benchmark>/<algo>")
    assert unescaped.tags.difference(TAGS) == {"benchmark", "algo"}


def test_search_works_from_disk(site, tab):
    tab.open(site / "index.html")
    tab.evaluate("document.querySelector('.md-search__input').focus()")
    tab.call("Input.insertText", text="packnet")
    assert tab.until("document.querySelectorAll('.md-search-result__item').length") > 2
    links = "[...document.querySelectorAll('.md-search-result__link')].map(link => link.getAttribute('href'))"
    assert any("methods.html" in link for link in tab.evaluate(links))


SCHEME = "document.body.getAttribute('data-md-color-scheme')"
BACKGROUND = "getComputedStyle(document.body).backgroundColor"


def test_the_site_is_as_dark_as_the_system_and_as_the_reader_says(site, tab):
    tab.open(site / "index.html", dark=True)
    assert tab.until(SCHEME) == "slate"
    dark = tab.evaluate(BACKGROUND)
    tab.open(site / "index.html")
    assert tab.until(SCHEME) == "default"
    assert tab.evaluate(BACKGROUND) == "rgb(255, 255, 255)" != dark
    for chosen in ("default", "slate"):
        tab.evaluate("[...document.querySelectorAll('label[for^=__palette]')].find(l => !l.hidden).click()")
        assert tab.evaluate(SCHEME) == chosen
    assert tab.evaluate(BACKGROUND) == dark
    tab.open(site / "install.html")
    assert tab.until(SCHEME) == "slate", "the choice holds on other pages"
    tab.evaluate("localStorage.clear()")


def test_every_page_reads_on_a_phone(site, tab):
    assert [fault for page, _ in built(site) for fault in tab.faults_on_a_phone(page)] == []
