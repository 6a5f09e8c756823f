"""ns-viewer in a real browser: the time slider moves the weather, and so does the play button."""

import io
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plugin_scene import tiny_config, train, write_scene

pytestmark = pytest.mark.browser
# Chromium draws WebGL in software, which it does only if told to.
FLAGS = (
    "--headless=new --no-sandbox --disable-dev-shm-usage --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--ignore-gpu-blocklist --window-size=1200,1100"
)
SLIDER = "//*[normalize-space(text())='{}']/following::*[@role='slider'][1]"
PATIENCE = 120  # s


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of ns-viewer, showing a run in its own process."""
    from pgsd_nerfstudio.laboratory.tiny_cogvideox import write_tiny

    folder = tmp_path_factory.mktemp("run")
    dense = {"max_particles": 4000, "seconds": 2.0, "steps": 1}
    config = train(tiny_config(write_scene(folder), write_tiny(folder / "prior"), folder / "outputs", **dense))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    flags = ["--load-config", str(config), "--viewer.websocket-port", str(port), "--viewer.websocket-host", "127.0.0.1"]
    log = folder / "viewer.log"
    with log.open("w") as output:
        program = [sys.executable, "-m", "nerfstudio.scripts.viewer.run_viewer", *flags]
        process = subprocess.Popen(program, stdout=output, stderr=subprocess.STDOUT)
    try:
        within(PATIENCE, lambda: listening(port), lambda: f"ns-viewer does not answer: {log.read_text()[-2000:]}")
        yield f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def browser(viewer: str) -> Iterator:
    """Chromium with the viewer's page, once its first picture has come."""
    webdriver = pytest.importorskip("selenium.webdriver")
    chromium, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.skip("needs chromium and chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in FLAGS.split():
        options.add_argument(flag)
    page = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        page.get(viewer)
        within(PATIENCE, lambda: picture(page).std() > 10, lambda: "no picture has come")
        yield page
    finally:
        page.quit()


def test_the_time_slider_moves_the_weather(browser, tmp_path: Path):
    before = settled(browser)
    press(browser, "Time", "END")
    within(PATIENCE, lambda: changed(before, picture(browser)), lambda: "the picture stays as it was")
    assert slider(browser, "Time").get_attribute("aria-valuenow") == "1"
    press(browser, "Time", "HOME")
    within(PATIENCE, lambda: not changed(before, picture(browser)), lambda: "time 0 does not look as before")


def test_play_moves_time_and_picture_by_itself(browser):
    before = settled(browser)
    button = browser.find_element("xpath", "//button[contains(., 'Play / pause')]")
    browser.execute_script("arguments[0].click()", button)
    within(PATIENCE, lambda: now(browser) > 0.3, lambda: f"time stands still at {now(browser)}")
    browser.execute_script("arguments[0].click()", button)
    assert changed(before, settled(browser))
    stopped = now(browser)
    time.sleep(1)
    assert now(browser) == stopped


def picture(page) -> np.ndarray:
    """What is shown beside the panel, [H, W, 3]."""
    shown = Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB")
    return np.asarray(shown, dtype=np.float32)[80:-10, :850]


def changed(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether more of the picture differs than compression explains."""
    return float((np.abs(a - b).max(axis=2) > 25).mean()) > 0.001


def settled(page) -> np.ndarray:
    """The picture once it has come in full resolution."""
    last = [picture(page)]

    def still() -> bool:
        time.sleep(2)
        last.append(picture(page))
        return float(np.abs(last[-1] - last[-2]).mean()) < 0.05

    within(PATIENCE, still, lambda: "the picture does not come to rest")
    return last[-1]


def slider(page, label: str):
    return page.find_element("xpath", SLIDER.format(label))


def now(page) -> float:
    """The time that the slider shows."""
    return float(slider(page, "Time").get_attribute("aria-valuenow"))


def press(page, label: str, key: str) -> None:
    from selenium.webdriver.common.keys import Keys

    page.execute_script("arguments[0].focus()", slider(page, label))
    slider(page, label).send_keys(getattr(Keys, key))


def listening(port: int) -> bool:
    with socket.socket() as line:
        return line.connect_ex(("127.0.0.1", port)) == 0


def within(seconds: float, condition: Callable[[], bool], complaint: Callable[[], str]) -> None:
    """Wait until the condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, complaint()
        time.sleep(0.5)
