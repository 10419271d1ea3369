"""Open a page in a real browser without a display, and print what came of it as JSON.

    python tests/browser.py report.html picture.png

The browser is Qt's Chromium (``pip install pyside6-webengine pyside6-addons``). Printed: ``loaded``, ``requests`` (every
address that the page asked for), ``console`` (what its scripts and the browser said), ``images`` (the natural width of
each, 0 where it is broken), ``drawings`` (the sizes of its SVGs), ``text``, ``height``.
"""

import json
import os
import sys
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
os.environ.setdefault("QTWEBENGINE_CHROMIUM_FLAGS", "--no-sandbox --disable-gpu")
os.environ.setdefault("QTWEBENGINE_DISABLE_SANDBOX", "1")

from PySide6.QtCore import QTimer, QUrl
from PySide6.QtWebEngineCore import QWebEnginePage, QWebEngineProfile, QWebEngineUrlRequestInterceptor
from PySide6.QtWebEngineWidgets import QWebEngineView
from PySide6.QtWidgets import QApplication

LOOK = """JSON.stringify({
  images: [...document.images].map(image => image.naturalWidth),
  drawings: [...document.querySelectorAll("svg")].map(svg => svg.getBoundingClientRect().width),
  text: document.body.innerText,
  height: document.documentElement.scrollHeight,
})"""


class Watch(QWebEngineUrlRequestInterceptor):
    def __init__(self):
        super().__init__()
        self.seen = []

    def interceptRequest(self, info):
        self.seen.append(info.requestUrl().toString()[:100])


class Page(QWebEnginePage):
    console = []

    def javaScriptConsoleMessage(self, level, message, line, source):
        self.console.append(message)


def main(path: str, picture: str) -> None:
    app, watch, profile = QApplication(sys.argv[:1]), Watch(), QWebEngineProfile()
    profile.setUrlRequestInterceptor(watch)
    view = QWebEngineView()
    page = Page(profile, view)
    view.setPage(page)
    view.resize(1000, 1600)

    def look(loaded: bool) -> None:
        page.runJavaScript(LOOK, 0, lambda found: wait(loaded, found, 40))

    def wait(loaded: bool, found: str, times: int) -> None:
        """Until something is painted; then the whole window is a moment later."""
        shown = view.grab().toImage()
        blank = all(shown.pixel(x, 40) == shown.pixel(0, 0) for x in range(0, shown.width(), 5))
        if times and blank:
            QTimer.singleShot(500, lambda: wait(loaded, found, times - 1))
        else:
            QTimer.singleShot(1500, lambda: finish(loaded, found))

    def finish(loaded: bool, found: str) -> None:
        view.grab().save(picture)
        seen = {"loaded": loaded, "requests": watch.seen, "console": page.console}
        print(json.dumps(seen | json.loads(found)), flush=True)
        app.quit()

    page.loadFinished.connect(look)
    view.load(QUrl.fromLocalFile(str(Path(path).resolve())))
    view.show()
    app.exec()
    os._exit(0)  # the browser's own end is not ours to wait for


if __name__ == "__main__":
    main(*sys.argv[1:])
