"""The page that shows a fit: where it is served, its controls, and what a browser sees."""

import gc
import http.client
import socket
import sys
import threading
import urllib.request
from contextlib import ExitStack, closing
from types import SimpleNamespace

import numpy as np
import pytest
import viser
from browser import Browser, program, until
from rts_viewer.front import Front
from rts_viewer.history import History, State
from rts_viewer.pictures import loss_curve, small
from viewed import GREEN, RED, ball, free_port, view, watching
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import rts

pytestmark = pytest.mark.files


def other_address():
    """An address of this machine other than that of localhost; None if there is none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tried:
        try:
            tried.connect(("192.0.2.1", 9))  # Chooses an interface; nothing is sent.
        except OSError:
            return None
        address = tried.getsockname()[0]
    return None if address.startswith("127.") else address


def answer(watch, name="127.0.0.1", origin=None, address="127.0.0.1"):
    """The status with which a websocket is opened, 101 if the scene is sent, by a browser that knows a name for it."""
    port = int(watch.url.rpartition(":")[2])
    with socket.create_connection((address, port), timeout=10) as opened:
        protocol = f"viser-v{viser.__version__}"
        try:
            with connect(f"ws://{name}:{port}", sock=opened, origin=origin, subprotocols=[protocol]) as page:
                assert isinstance(page.recv(timeout=10), bytes)
                return 101
        except InvalidStatus as refused:
            assert b"other sites" in refused.response.body
            return refused.response.status_code


# --------------------------------------------------------------------------------------------- where it is served


def test_pages_of_other_sites_are_refused():
    evil = "http://evil.example"
    with watching() as watch:
        port = watch.url.rpartition(":")[2]
        assert answer(watch) == 101  # No browser: without an origin.
        for name in ("127.0.0.1", "localhost", "[::1]"):
            assert answer(watch, name, f"http://{name}:{port}") == 101
        assert answer(watch, "LOCALHOST", "http://127.0.0.1:9000") == 101  # Led here by ssh, say.
        for origin in (evil, f"{evil}:{port}", "https://127.0.0.1.evil.example", "http://[broken", "null"):
            assert answer(watch, origin=origin) == 403
        assert answer(watch, "evil.example", f"{evil}:{port}") == 403  # By DNS rebinding both are the site's.
        assert answer(watch, "evil.example") == answer(watch, "0.0.0.0", evil) == answer(watch, "192.0.2.1") == 403


def test_without_a_websocket_the_page_is_refused_too():
    with watching() as watch:
        port = int(watch.url.rpartition(":")[2])
        for name, status in ((f"127.0.0.1:{port}", 200), ("localhost", 200), ("evil.example", 403), ("a:b", 403)):
            with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10)) as connection:
                connection.request("GET", "/", headers={"Host": name})
                found = connection.getresponse()
                assert found.status == status and (b"<html" in found.read()) == (status == 200)
        with socket.create_connection(("127.0.0.1", port), timeout=10) as opened:
            opened.sendall(b"GET / HTTP/1.1\r\n\r\n")
            assert opened.recv(100).startswith(b"HTTP/1.1 403 ")


def test_a_host_that_is_asked_for_widens_who_is_served():
    address, own = other_address(), socket.gethostname()
    if address is None:
        pytest.skip("the machine has no other address")
    with watching(host="0.0.0.0") as watch:
        port = watch.url.rpartition(":")[2]
        for name in (address, own, own + ".local", "localhost"):
            assert answer(watch, name, f"http://{name}:{port}", address) == 101
        assert answer(watch, address, "http://192.0.2.1", address) == 403
        assert answer(watch, "evil.example", "http://evil.example", address) == 403
        assert answer(watch, address, "http://evil.example", address) == 403
    with watching(host=address) as watch:
        assert answer(watch, address, f"http://{address}:{port}", address) == 101
        assert answer(watch, "192.0.2.1", None, address) == 403


def test_the_server_behind_listens_where_no_page_looks():
    with watching() as watch:
        port, front = int(watch.url.rpartition(":")[2]), watch._page._front
        address, hidden = front._behind
        assert address.startswith("127.") and address != "127.0.0.1" and hidden != port
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", hidden), timeout=10)


def test_an_end_with_open_connections_is_quiet_and_ends_them(capfd):
    with watching() as watch:
        port, protocol = int(watch.url.rpartition(":")[2]), f"viser-v{viser.__version__}"
        page = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol])
        page.recv(timeout=10)
        silent = socket.create_connection(("127.0.0.1", port), timeout=10)
        silent.sendall(b"GET")
    with pytest.raises(ConnectionClosed):
        while True:
            page.recv(timeout=10)
    assert silent.recv(10) == b""
    silent.close()
    assert not watch._page._front._thread.is_alive()
    out = capfd.readouterr()
    assert not out.out and not out.err


def test_connections_that_come_as_it_ends_are_closed():
    for _ in range(20):
        port = free_port()
        front = Front("127.0.0.1", port, ("127.0.0.1", free_port()))
        with ExitStack() as opened:
            for _ in range(5):
                opened.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10)).sendall(b"GET")
            front.close()
            assert not front._thread.is_alive()
        gc.collect()  # A socket that was left open would warn here.


def test_only_this_machine_sees_the_page():
    with watching() as watch:
        with urllib.request.urlopen(watch.url, timeout=10) as answer:
            assert answer.status == 200 and b"<html" in answer.read()[:200]
        address = other_address()
        if address is None:
            pytest.skip("the machine has no other address")
        port = int(watch.url.rpartition(":")[2])
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((address, port), timeout=10)


def test_other_machines_see_it_if_asked_for():
    address = other_address()
    if address is None:
        pytest.skip("the machine has no other address")
    with watching(host="0.0.0.0") as watch:
        port = int(watch.url.rpartition(":")[2])
        with urllib.request.urlopen(f"http://{address}:{port}", timeout=10) as answer:
            assert answer.status == 200


def test_a_port_in_use_is_refused_and_free_again_after_close():
    port = free_port()
    with watching(port=port):
        with pytest.raises(rts.InputError, match=rf"^port {port} of 127.0.0.1 is in use.*--port"):
            with watching(port=port):
                pass
    with watching(port=port) as watch:
        assert watch.url == f"http://127.0.0.1:{port}"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"port": 0}, "port is 0; expected an integer from 1 to 65535"),
        ({"port": 70000}, "port is 70000"),
        ({"port": "8080"}, "port is '8080'"),
        ({"host": "nowhere.invalid"}, "host 'nowhere.invalid' is unknown"),
        ({"host": "192.0.2.1"}, "host '192.0.2.1' is no address of this machine"),
        ({"host": ""}, "host is ''"),
        ({"host": None}, "host is None"),
    ],
)
def test_a_wrong_address_is_refused_in_one_line(options, told):
    with pytest.raises(rts.InputError, match=told) as caught:
        with watching(**options):
            pass
    assert "\n" not in str(caught.value)


def test_without_viser_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(rts.errors.PluginError, match=r"needs viser.*pip install \./apps/viewer"):
        with watching():
            pass


# -------------------------------------------------------------------------------------------------- controls


def test_a_pause_blocks_and_going_on_continues():
    vertices, faces, colors = ball()
    with watching() as watch:
        watch.begin([])
        assert watch.step(0, 1.0, vertices, faces, colors) is False
        watch.pause()
        results = []
        thread = threading.Thread(target=lambda: results.append(watch.step(1, 0.5, vertices, faces, None)))
        thread.start()
        thread.join(0.5)
        assert thread.is_alive() and watch.paused and not results
        watch.go_on()
        thread.join(10)
        assert results == [False] and not watch.paused


@pytest.mark.parametrize("paused", [False, True])
def test_stop_ends_a_fit_even_a_paused_one(paused):
    torch = pytest.importorskip("torch")
    vertices, faces, _ = ball()
    target, calls = torch.tensor(0.3 * vertices), []
    with watching() as watch:
        watch.begin()

        def callback(step, parameters, loss):
            calls.append(step)
            if len(calls) == 5:
                if paused:
                    watch.pause()
                threading.Timer(0.2, watch.stop).start()
            return watch.step(step, loss, parameters.detach().numpy(), faces)

        settings = {"tolerance": 0.0, "patience": 10**6, "steps": 10**6, "callback": callback}
        fit = rts.fit(lambda p: p - target, torch.tensor(vertices), progress=False, **settings)
        watch.end()
        assert 5 <= fit.steps < 10**6 and fit.steps == len(calls)
        assert not paused or fit.steps == 5
        watch.begin()  # A new fit is not stopped.
        assert watch.step(0, 1.0, vertices, faces) is False


def test_a_fit_may_be_stopped_after_the_page_is_closed():
    vertices, faces, _ = ball()
    with watching() as watch:
        watch.begin()
    for press in (watch.pause, watch.go_on, watch.stop, watch.end):
        press()
    assert watch.step(0, 1.0, vertices, faces) is True


def test_buttons_are_not_changed_while_the_page_closes(monkeypatch):
    failures, changing, gone = [], threading.Event(), threading.Event()
    monkeypatch.setattr(threading, "excepthook", failures.append)

    class Slow:
        """A button whose change takes until the page has closed, if that does not wait for it."""

        def __setattr__(self, name, value):
            changing.set()
            if watch._closing.wait(0.5):
                gone.wait(30)

    with watching() as watch:
        watch.begin()
        watch._pause_button = Slow()
        press = threading.Thread(target=watch.end)
        press.start()
        assert changing.wait(30)
    gone.set()
    press.join(30)
    assert not failures, failures[0].exc_value


def test_pictures_that_are_read_while_the_page_closes_are_left_out(monkeypatch):
    failures, reading, gone = [], threading.Event(), threading.Event()
    monkeypatch.setattr(threading, "excepthook", failures.append)
    known = view((0, 0, 3))

    def late():
        reading.set()
        gone.wait(30)
        return known.image

    before = set(threading.enumerate())
    with watching() as watch:
        watch.begin([rts.View(known.camera, late, known.size)])
        assert reading.wait(30)
    gone.set()
    for thread in set(threading.enumerate()) - before:
        thread.join(30)
    assert not failures, failures[0].exc_value


def test_the_slider_goes_back_and_following_goes_on():
    vertices, faces, _ = ball()
    with watching() as watch:
        watch.begin()
        for number in (0, 10, 20):
            watch.step(number, 1.0, vertices, faces)
        until(lambda: watch._slider.value == 20, 30)
        user = SimpleNamespace(client="one")  # What viser tells of an event that came from a browser.
        watch._slider.value = 12
        watch._slid(user)
        until(lambda: "step 10**" in watch._text.content, 30)
        watch.step(30, 1.0, vertices, faces)
        until(lambda: "at step 30" in watch._text.content, 30)
        assert watch._slider.value == 12 and "step 10**" in watch._text.content and not watch._follow.value
        watch._follow.value = True
        watch._followed(user)
        until(lambda: "step 30**" in watch._text.content and watch._slider.value == 30, 30)


def test_steps_are_checked_and_copied():
    vertices, faces, colors = ball()
    with watching() as watch:
        for arrays, told in (
            ((vertices[:, :2], faces, None), "vertices"),
            ((vertices * np.nan, faces, None), "vertices is .*expected finite numbers"),
            ((vertices, faces[:, :2], None), "faces"),
            ((vertices[:-1], faces, None), "do not fit 161 vertices"),
            ((vertices, faces, colors[:-1]), "colors"),
        ):
            with pytest.raises(rts.InputError, match=told):
                watch.step(0, 1.0, *arrays)
        with pytest.raises(rts.InputError, match=r"views holds .*rts\.View"):
            watch.begin(["view"])
        watch.step(0, 1.0, vertices, faces, colors)
        vertices[:] = 7
        assert np.abs(watch._history.newest.vertices).max() <= 1


def test_the_history_is_bounded_and_even():
    history, empty = History(), np.zeros((0, 3))
    for number in range(1234):
        history.add(State(number, 0.0, empty, empty, None))
        numbers = [state.number for state in history.states]
        assert len(numbers) == min(number + 1, len(numbers)) <= 50
        assert numbers[0] == 0 and numbers[-1] == number
        assert len(set(np.diff(numbers[:-1]))) <= 1  # Equal distances, but for the last.
        assert len(numbers) > min(number, 24)
    assert history.nearest(640).number == 640 and history.nearest(10**6).number == 1233


# -------------------------------------------------------------------------------------------------- pictures


def line(steps, losses):
    """Columns and mean rows of the blue pixels of a curve."""
    picture = loss_curve(np.array(steps, float), np.array(losses, float)).astype(int)
    down, right = np.nonzero(picture[..., 2] - picture[..., 0] > 100)
    columns = np.unique(right)
    return columns, np.array([down[right == column].mean() for column in columns])


def test_the_curve_of_an_exponential_is_a_straight_line():
    columns, rows = line(range(100), np.exp(-0.1 * np.arange(100)))
    inside = slice(5, -10)  # Away from the dot at the end.
    slope, offset = np.polyfit(columns[inside], rows[inside], 1)
    assert slope == pytest.approx((160 - 2 * 18) / (320 - 2 * 18), rel=0.02)
    assert np.abs(rows[inside] - slope * columns[inside] - offset).max() < 1.5


def test_losses_that_are_not_finite_are_left_out_of_the_curve():
    expected = line(range(0, 100, 2), np.arange(50) - 10.0)
    losses = np.full(100, np.nan)
    losses[::2] = np.arange(50) - 10.0
    np.testing.assert_array_equal(line(range(100), losses)[1], expected[1])
    assert line([], [])[0].size == 0


def test_small_pictures_are_encoded_on_white():
    image = np.zeros((300, 600, 4), np.float32)
    image[:, :300] = (0.5, 0, 0, 1)
    picture = small(image, 128)
    assert picture.shape == (64, 128, 3)
    assert picture[32, 10].tolist() == [188, 0, 0] and picture[32, 118].tolist() == [255, 255, 255]


# ---------------------------------------------------------------------------------------------- in a browser


def share(picture, color):
    """The share of the middle that is mostly of a colour: red 0, green 1 or blue 2. Beside it are panel and notes."""
    picture = picture[:, 320:760].astype(int)
    rest = np.delete(picture, color, axis=-1).max(axis=-1)
    return (picture[..., color] > 1.6 * rest + 20).mean()


@pytest.mark.skipif(program() is None, reason="no browser on PATH; expected Debian's package chromium")
@pytest.mark.thorough
def test_a_browser_shows_the_fit_and_its_buttons_work(tmp_path):
    vertices, faces, red = ball(RED)
    with watching() as watch, Browser(watch.url, tmp_path) as browser:
        until(lambda: "no step yet" in browser.text(), 120)
        assert share(browser.picture(), 0) < 1e-4
        watch.begin([view((-1.2, 0.3, 0.8), GREEN)])
        watch.step(0, 1.0, vertices, faces, red)
        until(lambda: share(browser.picture(), 0) > 0.05, 120)  # The mesh.
        until(lambda: share(browser.picture(), 1) > 0.002, 120)  # The picture on the camera's frustum.
        watch.step(7, 0.25, 1.2 * vertices, faces, red[:, ::-1])
        until(lambda: "step 7, loss 0.25" in browser.text() and share(browser.picture(), 2) > 0.05, 120)
        assert share(browser.picture(), 0) < 1e-3
        browser.click("pause")
        until(lambda: watch.paused, 10)
        browser.click("go on")
        until(lambda: not watch.paused, 10)
        browser.click("stop")
        until(lambda: watch.step(8, 0.2, vertices, faces, red), 10)
        watch.end()
        waiting = threading.Thread(target=watch.wait)
        waiting.start()
        browser.click("close")
        waiting.join(10)
        assert not waiting.is_alive()
