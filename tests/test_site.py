"""The documentation as a browser shows it: what `make docs` has built into site/."""

import functools
import http.server
import threading
from pathlib import Path

import pytest

SITE = Path(__file__).parents[1] / "site"
PAGES = sorted(str(path.parent.relative_to(SITE)) for path in SITE.rglob("index.html"))

WIDEST = "Math.max(document.documentElement.scrollWidth, document.body.scrollWidth, innerWidth)"

pytestmark = pytest.mark.skipif(not PAGES, reason="make docs has not been run")


class Silent(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def address():
    """Where the site is served."""
    handler = functools.partial(Silent, directory=str(SITE))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize("width", [1360, 390])
@pytest.mark.parametrize("page", PAGES)
def test_a_page_has_no_errors_asks_no_third_party_and_fits(browser, address, page, width):
    browser.open(f"{address}/{page}/", width=width)
    elsewhere = [url for url in browser.requests if not url.startswith((address, "data:", "blob:"))]
    assert (browser.problems, elsewhere) == ([], [])
    assert browser.run(WIDEST) <= width  # innerWidth would grow with what is too wide
    assert browser.run("[...document.images].every(image => image.loading == 'lazy' || image.naturalWidth > 0)")


def test_equations_are_drawn(browser, address):
    browser.open(f"{address}/algorithm/")
    assert browser.run("document.querySelectorAll('.arithmatex').length") == 0  # left as they were written
    heights = browser.run("[...document.querySelectorAll('math')].map(one => one.getBoundingClientRect().height)")
    assert len(heights) > 50 and min(heights) > 5


def test_a_word_is_found(browser, address):
    browser.open(f"{address}/")
    browser.run("document.querySelector('[data-md-component=search-query]').focus()")
    query = "document.querySelector('[data-md-component=search-query]')"
    browser.run(f"{{ {query}.value = 'zonotope'; {query}.dispatchEvent(new Event('keyup')); 0 }}")
    hit = "document.querySelector('.md-search-result__item a')"
    look = f"const look = () => {hit} ? done({hit}.href) : setTimeout(look, 50); look()"
    found = f"new Promise((done, fail) => {{ setTimeout(fail, 8000); {look} }})"
    assert browser.run(found).startswith(address)
