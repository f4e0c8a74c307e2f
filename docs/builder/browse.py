"""Looks at the site that was built in a browser: what a reader meets.

    pip install playwright && apt-get install chromium
    python docs/builder/browse.py --screenshots shots

Serves `site/` on this machine and opens every page. Wrong are: a request that fails or goes to
another host, an error of a script, TeX or a citation that is left, a page that is wider than a
phone, a search without a result.
"""

import argparse
import functools
import http.server
import re
import shutil
import sys
import threading
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

ROOT = Path(__file__).parents[2]
SEARCHES = {
    "GuidedBridge": "api/bridges/",
    "KunitaFlow": "api/sdes/",
    "tps": "api/io/",
    "LOO": "glossary/",
    "pareto": "",
    "to_arviz": "api/infer/",
    "newick": "trees/",
    "procrustes": "api/shapes/",
    "length scale": "",
    "missing points": "",
    "checkpointed": "long_runs/",
    "OPENBLAS_NUM_THREADS": "troubleshooting/",
}
PHONE, DESK = {"width": 390, "height": 844}, {"width": 1280, "height": 900}
LOOKS = [
    ("home", "", DESK, "light"),
    ("reference", "api/bridges/", DESK, "light"),
    ("mathematics", "mathematics/", DESK, "light"),
    ("dark", "mathematics/", DESK, "dark"),
    ("phone", "mathematics/", PHONE, "light"),
]


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


def serve(folder: Path) -> str:
    handler = functools.partial(QuietHandler, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_port}/"


def problems_of_requests(page: Page, home: str) -> list[str]:
    """A list that fills while the page is used."""
    found: list[str] = []

    def see(response):
        if response.status >= 400:
            found.append(f"{response.status} for {response.url}")

    def see_request(request):
        if not request.url.startswith((home, "data:", "blob:")):
            found.append(f"another host: {request.url}")

    page.on("response", see)
    page.on("request", see_request)
    page.on("requestfailed", lambda request: found.append(f"failed: {request.url}"))
    page.on("pageerror", lambda error: found.append(f"script: {error}"))
    return found


def visit_all(browser: Browser, home: str, paths: list[str]) -> list[str]:
    page = browser.new_page(viewport=PHONE)
    requests = problems_of_requests(page, home)
    found = []
    for path in paths:
        page.goto(home + path, wait_until="networkidle")
        text = page.evaluate("document.querySelector('article')?.innerText ?? ''")
        code = page.evaluate(
            "[...document.querySelectorAll('article code')].map(c => c.innerText).join('\\n')"
        )
        for raw in re.findall(r"\[@\w+\]|\\[()\[\]A-Za-z]\S*|\$\$", text):
            if raw not in code:
                found.append(f"/{path}: {raw}")
        if page.evaluate("document.documentElement.scrollWidth > window.innerWidth"):
            found.append(f"/{path}: wider than a phone")
    page.close()
    return found + requests


def search_all(browser: Browser, home: str) -> list[str]:
    page = browser.new_page(viewport=DESK)
    page.goto(home, wait_until="networkidle")
    field = page.locator("input.md-search__input")
    results = page.locator(".md-search-result__meta")
    found = []
    for words, wanted in SEARCHES.items():
        field.fill("")
        field.press_sequentially(words)
        page.wait_for_timeout(500)  # results come from a worker, as one types
        results.filter(has_text=re.compile("matching")).wait_for()
        link = ".md-search-result__item a"
        targets = page.eval_on_selector_all(link, "links => links.map(link => link.href)")
        pages = [re.sub(r"[?#].*", "", target).removeprefix(home) for target in targets]
        print(f"search {words!r}: {len(pages)} results, first {pages[:1]}")
        if not pages or (wanted and wanted not in pages):
            found.append(f"search {words!r} does not find /{wanted}, but {pages[:5]}")
    page.close()
    return found


def look(browser: Browser, home: str, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, path, size, scheme in LOOKS:
        page = browser.new_page(viewport=size, color_scheme=scheme)
        page.goto(home + path, wait_until="networkidle")
        page.screenshot(path=folder / f"{name}.png")
        page.close()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--site", type=Path, default=ROOT / "site")
    parser.add_argument("--chromium", default=shutil.which("chromium"), help="the program")
    parser.add_argument("--screenshots", type=Path, help="a folder for pictures of a few pages")
    arguments = parser.parse_args()
    site = arguments.site.resolve()
    home = serve(site)
    paths = sorted(str(file.parent.relative_to(site)) + "/" for file in site.rglob("index.html"))
    paths = ["" if path == "./" else path for path in paths]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=arguments.chromium, args=["--no-sandbox"]
        )
        found = visit_all(browser, home, paths) + search_all(browser, home)
        if arguments.screenshots:
            look(browser, home, arguments.screenshots)
        browser.close()
    print(f"{len(paths)} pages, {len(SEARCHES)} searches, {len(found)} problems", *found, sep="\n")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
