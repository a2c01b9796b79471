"""Clicked pairs are saved by the page, fitted to cameras, and used to evaluate registration."""

import http.client
import json
import shutil
import threading
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import sync_playwright

from pipeline.core.errors import InputError
from pipeline.core.videos import read as read_videos
from pipeline.data import clicks
from pipeline.data.poses import RegisteredPoses
from pipeline.geometry import rigid
from stages.annotate import __main__ as front
from stages.annotate import serving, stage
from stages.evaluate import clicked, real_phone
from stages.evaluate.reading import BuildFolders
from tests.stages.annotate import clicked_room
from tests.stages.annotate.clicked_room import SESSION, WALKTHROUGH
from tests.stages.export_simulator.browser import CHROMIUM, FLAGS


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return clicked_room.build(tmp_path_factory.mktemp("build"))


@contextmanager
def running(room, path):
    server = serving.ClickServer(front._session(room.build, path), 0)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()


def folders(room, registration) -> BuildFolders:
    frames = {id: room.build / "frames" / id for id in ("v000", "v001")}
    nowhere = room.build / "none"
    unread = dict.fromkeys(("agent_template", "reconstruction", "scene_localizer", "splats"), nowhere)
    template = room.build / "scene_template"
    return BuildFolders(
        frames=frames,
        masks={},
        flow={},
        scene_template=template,
        registration=registration,
        truth=None,
        **unread,
    )


def click(page, view: str, pixel) -> None:
    box = page.locator(f"#{view} img").bounding_box()
    page.mouse.click(box["x"] + pixel[0] * box["width"], box["y"] + pixel[1] * box["height"])


def test_sessions_without_depth_are_found_where_the_map_s_depth_is(room, tmp_path):
    build = tmp_path / "build"
    shutil.copytree(room.build, build)
    videos = json.loads((build / "plan" / "videos.json").read_text())
    (build / "plan" / "videos.json").write_text(json.dumps([videos[0], videos[1] | {"mapped": True}]))
    (build / "estimated_frames").mkdir()
    (build / "frames" / "v001").rename(build / "estimated_frames" / "v001")
    assert front._session(build, tmp_path / "clicks.json")


def test_seven_clicks_in_a_browser_measure_registration(room, tmp_path):
    wanted, path = room.pairs(1, 7, np.random.default_rng(0)), tmp_path / "captures" / "clicks.json"
    with running(room, path) as port, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page, wrong = browser.new_page(viewport={"width": 1000, "height": 700}), []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.goto(f"http://127.0.0.1:{port}/")
        page.wait_for_selector("body[data-ready]")
        page.click("#frames button:nth-child(2)")
        for number, pair in enumerate(wanted, start=1):
            page.click(f"#references button:nth-child({pair.reference.source_index // 3 + 1})")
            page.wait_for_function(
                "[...document.querySelectorAll('.view img')].every((img) => "
                "img.complete && img.clientHeight > 50)"
            )
            click(page, "seen", pair.seen.pixel)
            page.wait_for_function(
                "[...document.querySelectorAll('.view img')].every((img) => "
                "img.complete && img.clientHeight > 50)"
            )
            click(page, "reference", pair.reference.pixel)
            page.wait_for_function(f"document.querySelectorAll('#pairs li').length == {number}")
        page.wait_for_function("document.getElementById('status').textContent.includes('mm left')")
        assert "7 of 7" in page.inner_text("#status")
        browser.close()
    assert wrong == []
    kept = clicks.read(path)
    assert len(kept) == 7
    for pair, true in zip(kept, wanted, strict=True):
        np.testing.assert_allclose(pair.seen.pixel, true.seen.pixel, atol=0.006)
        assert pair.reference.source_index == true.reference.source_index
    _measures(room, path, tmp_path)


def _measures(room, path, tmp_path) -> None:
    """A registration error of 3 degrees and 20 cm is measured as such."""
    off = rigid.make(rigid.rotation_from_vector(np.radians([0, 3.0, 0])), np.zeros(3))
    ours = room.session.truth @ off
    ours[:, :3, 3] += [0.2, 0, 0]
    (tmp_path / "registration" / "v001").mkdir(parents=True)
    replace(RegisteredPoses.unknown(np.arange(float(len(ours)))), world_from_camera=ours).write(
        tmp_path / "registration" / "v001"
    )
    where, videos = folders(room, tmp_path / "registration"), read_videos(room.build / "plan" / "videos.json")
    cameras = clicked.cameras_from_clicks(path, where, videos)
    metrics = clicked.clicked_metrics(cameras, where, videos)
    assert metrics.values["registration/clicked_frames"] == 1
    assert metrics.values["registration/clicked_residual_m_median"] < 0.03
    assert abs(metrics.values["registration/rotation_deg_median"] - 3) < 1
    assert abs(metrics.values["registration/translation_m_median"] - 0.2) < 0.03
    refused = clicked.clicked_metrics(cameras, folders(room, tmp_path / "nothing"), videos)
    assert refused.values["registration/rotation_deg_median"] is None


def test_exact_clicks_give_the_camera(room):
    parts = [clicks.ClickedClip.open(room.build / "frames" / id) for id in ("v001", "v000")]
    fit = clicks.fit(room.pairs(2, 7, np.random.default_rng(1)), *parts, room.walkthrough.truth)
    assert (
        np.degrees(rigid.rotation_angle(fit.world_from_camera[:3, :3], room.session.truth[2, :3, :3])) < 0.6
    )
    np.testing.assert_allclose(fit.world_from_camera[:3, 3], room.session.truth[2, :3, 3], atol=0.015)
    assert clicks.fit(room.pairs(2, 3, np.random.default_rng(1)), *parts, room.walkthrough.truth) is None


def test_inconsistent_clicks_are_rejected(room, tmp_path):
    pairs = room.pairs(0, 7, np.random.default_rng(2))
    spots = [pair.reference for pair in pairs]
    mixed = [clicks.ClickedPair(pair.seen, spots[(i + 3) % 7]) for i, pair in enumerate(pairs)]
    (tmp_path / "clicks.json").write_text(clicks.text(mixed))
    videos = read_videos(room.build / "plan" / "videos.json")
    cameras = clicked.cameras_from_clicks(tmp_path / "clicks.json", folders(room, tmp_path), videos)
    metrics = clicked.clicked_metrics(cameras, folders(room, tmp_path), videos)
    assert "disagree" in metrics.reasons["registration/rotation_deg_median"]


def test_clicked_cameras_are_propagated_by_odometry(room):
    truth, drifted = room.session.truth, room.session.truth @ rigid.make(np.eye(3), np.array([0.0, 0, 0]))
    odometry = rigid.exp(np.array([0.1, 2.0, -0.1, 3, 0, 1])) @ drifted
    some = clicked.Clicked(np.array([0, 2]), truth[[0, 2]], np.array([0.01, 0.02]))
    np.testing.assert_allclose(clicked.all_cameras(some, odometry, 4), truth, atol=1e-9)
    alone = clicked.all_cameras(some, None, 4)
    assert np.isnan(alone[1]).all()
    np.testing.assert_array_equal(alone[2], truth[2])
    votes = np.concatenate([np.repeat(truth[:1], 5, axis=0), truth[1:]])
    agreed, count = real_phone.agreement(votes)
    assert count >= 5
    assert real_phone.agreement(truth[:3]) is None
    np.testing.assert_allclose(agreed, truth[0], atol=0.2)


def ask(port: int, method: str, path: str, body: bytes = b"", **headers) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    given = {"Host": f"127.0.0.1:{port}", "Content-Type": "application/json"} | {
        k.replace("_", "-"): v for k, v in headers.items()
    }
    connection.request(method, path, body, given)
    code = connection.getresponse().status
    connection.close()
    return code


def test_server_refuses_other_hosts_and_origins(room, tmp_path):
    spot = {"recording": SESSION, "source_index": 0, "pixel": [0.5, 0.5]}
    pair = {"seen": spot, "reference": spot | {"recording": WALKTHROUGH}}
    good = json.dumps({"pairs": [pair]}).encode()
    with running(room, tmp_path / "clicks.json") as port:
        assert (
            ask(port, "GET", "/") == ask(port, "GET", "/state") == ask(port, "GET", "/picture/0/0.jpg") == 200
        )
        for host in (
            "evil.example",
            f"evil.example:{port}",
            "127.0.0.1",
        ):  # a host name that resolves to this machine
            assert ask(port, "GET", "/state", Host=host) == 403
        assert (
            ask(port, "GET", "/picture/0/99.jpg")
            == ask(port, "GET", "/picture/9/0.jpg")
            == ask(port, "GET", f"/picture/0/{'9' * 5000}.jpg")
            == ask(port, "GET", "/../x")
            == 404
        )
        assert ask(port, "POST", "/clicks", good, Origin="http://evil.example") == 403
        assert ask(port, "POST", "/clicks", good, Content_Type="text/plain") == 403
        for bad in (
            b"{",
            b"{}",
            b'{"pairs": [1]}',
            good.replace(b"0.5", b"1.5"),
            good.replace(b"session", b"sossion"),
        ):
            assert ask(port, "POST", "/clicks", bad) == 400
        for length in ("abc", "-1", "9" * 400, str(clicks.MAX_BYTES + 1)):
            assert ask(port, "POST", "/clicks", good, Content_Length=length) == 413
        assert not (tmp_path / "clicks.json").exists()
        assert ask(port, "POST", "/clicks", good) == 200
    assert len(clicks.read(tmp_path / "clicks.json")) == 1


def test_damaged_and_unwritable_click_files_are_reported(room, tmp_path):
    path = tmp_path / "clicks.json"
    spot = {"recording": SESSION, "source_index": 0, "pixel": [0.5, 0.5]}
    good = json.dumps({"pairs": [{"seen": spot, "reference": spot | {"recording": WALKTHROUGH}}]}).encode()
    with running(room, path) as port:
        path.write_text("{")
        assert ask(port, "GET", "/state") == 500
        path.unlink()
        path.mkdir()
        assert ask(port, "POST", "/clicks", good) == 400


def test_invalid_click_files_are_refused(tmp_path):
    (tmp_path / "clicks.json").write_text("{")
    with pytest.raises(InputError, match="EVA-001"):
        clicks.read(tmp_path / "clicks.json")
    assert front.main([str(tmp_path), "--clicks", str(tmp_path / "clicks.json")]) == 2


def test_sharpest_frame_of_each_segment_is_shown():
    assert stage.sharpest_per_stretch(np.array([0, 3, 1, 5, 4, 2.0]), 2) == [1, 3]
    assert stage.sharpest_per_stretch(
        np.array([0, 3, 1, 5, 4, 2.0]), 2, np.array([1, 0, 1, 0, 0, 0], bool)
    ) == [2]
