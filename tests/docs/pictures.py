"""Pictures in docs/ of the live view and a report, from loopbacks of one seed: `make pictures` (Chromium)."""

import base64
import tempfile
import threading
from pathlib import Path
from typing import NamedTuple

import msgspec
from click.testing import CliRunner
from websockets.sync.server import ServerConnection, serve

from companion.analysis.live.follow import FollowedLog
from companion.analysis.live.scene import Scene
from companion.analysis.live.server import answer_pages
from companion.analysis.report import command as report
from sitl.loopback import command as loopback
from tests.conftest import Browser

DOCS = Path(__file__).parents[2] / "docs"
SEED = 1


class Picture(NamedTuple):
    """Live view to show: file, scenario, time of the flight (s), window, colours, part of the map."""

    name: str
    scenario: str
    t: float
    width: int
    height: int
    dark: bool = False
    near: bool = False  # the map follows the aircraft


PICTURES = (
    Picture("live.png", "short", 218.0, 1280, 900),
    Picture("live-spoof.png", "spoof", 1230.0, 1280, 900, near=True),
    Picture("live-phone.png", "short", 262.0, 390, 844, dark=True),
)


def fly(scenario: str, folder: Path) -> Path:
    """Fly a scenario in virtual time and return its log."""
    done = CliRunner().invoke(loopback, f"--scenario {scenario} --seed {SEED} --logs {folder}")
    assert done.exit_code == 0, done.output
    (log,) = folder.glob("*.mcap")
    return log


def frame_at(log: Path, t: float) -> str:
    """Return what the live view shows `t` (s) after the start of the log."""
    source, scene = FollowedLog(log), Scene(log.name)
    while scene.t < t and not source.ended:
        for message in source.poll():
            scene.add(message)
            if scene.t >= t:
                break
    source.close()
    return msgspec.json.encode(scene.frame(None, False)).decode()


def screenshot(browser: Browser, width: int, height: int) -> bytes:
    """Return the top of the page as PNG."""
    clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
    return base64.b64decode(browser.call("Page.captureScreenshot", clip=clip)["data"])


def live_view(picture: Picture, log: Path, browser: Browser) -> bytes:
    """Return the live view of one moment as PNG."""
    frame = frame_at(log, picture.t)

    def send(client: ServerConnection) -> None:
        client.send(frame)
        for _ in client:  # until the page is left
            pass

    with serve(send, "127.0.0.1", 0, process_request=answer_pages(None)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser.open(f"http://127.0.0.1:{server.socket.getsockname()[1]}/", picture.width, picture.dark)
        browser.wait_for("document.querySelectorAll('#charts canvas').length >= 3")
        if picture.near:
            browser.evaluate("document.querySelector('[title=\"follow the aircraft\"]').click()")
        png = screenshot(browser, picture.width, picture.height)
        browser.open("about:blank")
        server.shutdown()
    return png


def head_of_report(log: Path, browser: Browser) -> bytes:
    """Return the head of the log's report as PNG."""
    page = log.with_suffix(".html")
    done = CliRunner().invoke(report, [str(log), "-o", str(page)])
    assert done.exit_code == 0, done.output
    browser.open(page.as_uri())
    browser.wait_for("document.querySelectorAll('canvas').length >= 3")
    return screenshot(browser, 1280, 900)


def save(name: str, png: bytes) -> None:
    """Write a picture into docs/."""
    (DOCS / name).write_bytes(png)
    print(f"docs/{name}: {len(png) // 1000} kB")


def main() -> None:
    """Write all pictures."""
    with tempfile.TemporaryDirectory() as folder, Browser(Path(folder) / "browser") as browser:
        browser.call("Emulation.setScrollbarsHidden", hidden=True)
        names = dict.fromkeys(picture.scenario for picture in PICTURES)
        logs = {name: fly(name, Path(folder) / name) for name in names}
        for picture in PICTURES:
            save(picture.name, live_view(picture, logs[picture.scenario], browser))
        save("report.png", head_of_report(logs["short"], browser))


if __name__ == "__main__":
    main()
