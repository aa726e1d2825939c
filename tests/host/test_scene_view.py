"""The 3-D view of a page: its data against the estimate, hostile names, and what a browser draws and reads from it."""

import base64
import hashlib
import html
import json
import re
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
from browser import needs_browser, probed
from puma_bench import CHAIN, DESIGN, RIG, ROBOT, TRUTH, random_table
from report_bench import HOSTILE, Strict, make_page, render

import truearm
from truearm.model.chain import forward, point_forward
from truearm.model.transforms import rotation
from truearm.report.page import view_section
from truearm.types import Device, Point, rms
from truearm.workflows.scene import AFTER, BEFORE, EXPECTED, calibration_scene

PLAIN = truearm.IdentifyOptions(joint_laws="none")
FOLDER = files("truearm.report").joinpath("view3d")


@pytest.fixture(scope="module")
def bars():
    return truearm.identify(ROBOT, random_table(90, np.random.default_rng(1), 8.4e-5), RIG, options=PLAIN, hold_out=0.2)


@pytest.fixture(scope="module")
def scene(bars):
    return calibration_scene(bars)


def data_of(text):
    return json.loads(re.search(r'id="scene">(.*?)</script>', text)[1])


def test_vectors_are_residuals_and_errors_of_the_model(bars, scene):
    """Along a bar: from the chuck to the sphere."""
    poses, field = scene.points
    residual = bars.estimate.residual["m"]
    np.testing.assert_allclose(np.linalg.norm(poses.vectors[AFTER], axis=1), np.abs(residual), rtol=1e-6, atol=1e-12)
    chucks = np.array([scene.fixtures[f"chuck.{name}"] for name in bars.table.chuck])
    along = poses.xyz - chucks
    along /= np.linalg.norm(along, axis=1)[:, None]
    np.testing.assert_allclose(np.einsum("ni,ni->n", along, poses.vectors[AFTER]), residual, atol=1e-12)
    spheres = np.array([RIG.spheres[name].xyz for name in bars.table.sphere])
    truth = point_forward(CHAIN, TRUTH, bars.table.q, spheres) - point_forward(CHAIN, DESIGN, bars.table.q, spheres)
    # base and tool of the nominal robot are placed, which takes part of the error away
    assert 0.2 < np.linalg.norm(poses.vectors[BEFORE]) / np.linalg.norm(truth) <= 1.0
    assert field.values[EXPECTED].shape == field.values[BEFORE].shape == (90,)
    error = point_forward(CHAIN, TRUTH, bars.table.q, spheres) - poses.xyz
    assert rms(np.linalg.norm(error, axis=1)) <= rms(field.values[EXPECTED])  # k = 2
    assert ((field.q >= poses.q.min(axis=0)) & (field.q <= poses.q.max(axis=0))).all()


def test_vectors_of_a_tracker_lie_in_the_base_frame():
    rng = np.random.default_rng(3)
    q, noise = random_table(60, rng).q, 1e-4 * rng.standard_normal((60, 3))
    tracker = Device("t", tuple(map(tuple, 1e-8 * np.eye(3))), (1.0, 0.5, 0.2), (0.3, -0.2, 1.0), 0.0, 0.0)
    turn = rotation(np.array(tracker.rotation))
    rig = truearm.Rig(targets={"ball": Point("ball", (0.0, 0.0, 0.05))}, trackers={"t": tracker})
    ball = point_forward(CHAIN, TRUTH, q, np.array([0.0, 0.0, 0.05]))
    table = truearm.ObservationTable(
        q=q, kind="position", tracker="t", target="ball", xyz=(ball - tracker.xyz) @ turn + noise @ turn
    )
    found = truearm.identify(ROBOT, table, rig, options=PLAIN)
    poses = calibration_scene(found).points[0]
    left = ball + noise - point_forward(CHAIN, found.identified, q, np.array([0.0, 0.0, 0.05]))
    np.testing.assert_allclose(poses.vectors[AFTER], left, atol=1e-9)


def test_the_page_runs_its_bundle_alone(scene):
    text, plain = render(make_page(60, scene=scene)), render(make_page(60))
    assert len(text) < 1.3e6
    assert text.count("<svg") == plain.count("<svg") > 3
    policy = re.search(r'Security-Policy" content="(.*?)"', text)[1]
    *_, body = re.findall(r"<script>(.*?)</script>", text, re.S)
    digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
    assert policy == f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    assert "script" not in plain
    for line in FOLDER.joinpath("SHA256SUMS").read_text().splitlines():
        digest, name = line.split()
        assert hashlib.sha256(FOLDER.joinpath(name).read_bytes()).hexdigest() == digest, f"{name}: make view3d"
    poses = replace(scene.points[0], labels=[f"{HOSTILE}</script><!--\ud800"] * 90)
    text = view_section(replace(scene, title=HOSTILE, points=(poses,), fixtures={HOSTILE: np.zeros(3)}))
    assert re.findall("</?script", text) == ["<script", "</script"]
    assert text.isascii()
    parsed = Strict(text)
    assert [tag for tag, _ in parsed.elements] == ["section", "h2", "script"]
    assert data_of(text)["title"] == HOSTILE
    assert data_of(text)["clouds"][0]["labels"][0].startswith(HOSTILE)


# A canvas is read by the page around it: the page's own policy lets no other script run.
AROUND = """<!DOCTYPE html><iframe id="page" width="500" height="500" srcdoc="PAGE"></iframe><pre id="probe"></pre><script>
onload = () => { const w = document.getElementById('page').contentWindow, d = w.document, seen = [];
  const canvas = d.querySelector('canvas'), copy = document.createElement('canvas').getContext('2d');
  const press = key => canvas.dispatchEvent(new w.KeyboardEvent('keydown', {key, bubbles: true, cancelable: true}));
  const look = () => { copy.canvas.width = canvas.width; copy.canvas.height = canvas.height; copy.drawImage(canvas, 0, 0);
    const words = new Uint32Array(copy.getImageData(0, 0, canvas.width, canvas.height).data.buffer);
    seen.push({colours: new Set(words).size, sum: words.reduce((a, b) => (a * 31 + b) >>> 0, 0), tool: canvas.dataset.tool,
      readout: d.querySelector('output').textContent, labels: [...d.querySelectorAll('label')].map(l => l.textContent)}); };
  look(); press('ArrowLeft'); look(); press('.'); look(); press('Home'); press(','); look();
  document.getElementById('probe').textContent = JSON.stringify({seen, loaded: w.performance.getEntriesByType('resource').length,
    hidden: d.getElementById('view3d').hidden, scale: d.querySelector('.scale').textContent}); };
</script>"""


@needs_browser
def test_a_browser_draws_the_arm_and_shows_the_numbers(bars, scene, tmp_path):
    page = render(make_page(60, scene=scene))
    probe = probed(tmp_path, AROUND.replace("PAGE", html.escape(page)))
    assert (probe["loaded"], probe["hidden"]) == (0, False)
    first, turned, second, again = probe["seen"]
    assert min(view["colours"] for view in probe["seen"]) > 200
    assert len({first["sum"], turned["sum"], second["sum"]}) == 3
    assert again["sum"] == first["sum"]  # Home and back
    assert "measured poses: 1 of 90" in first["labels"]
    assert any(re.fullmatch(r"vectors × \d+", text) for text in first["labels"])
    for row, view in ((0, first), (1, second)):
        shown = re.search(rf"{AFTER} ([\d.e-]+) mm; {BEFORE} ([\d.e-]+) mm; at (.*) mm", view["readout"]).groups()
        values = [1e3 * scene.points[0].values[name][row] for name in (AFTER, BEFORE)]
        assert [float(text) for text in shown[:2]] == pytest.approx(values, rel=5e-3)
        # the arm stands where the robot was: its tools are at the spheres
        end = forward(CHAIN, bars.identified, bars.table.q[row])
        spheres = [end[:3, :3] @ sphere.xyz + end[:3, 3] for sphere in RIG.spheres.values()]
        tools = np.array([float(text) for text in view["tool"].split(",")]).reshape(-1, 3)
        np.testing.assert_allclose(tools[1::2], spheres, atol=2e-3)  # gains of joints turn the drawn arm a little less
        assert [float(text) for text in shown[2].split(", ")] == pytest.approx(1e3 * scene.points[0].xyz[row], abs=0.6)


def thinned_scene(scene, rows, **missing):
    """Return the scene with these rows of its measured poses alone, and NaN where ``missing`` says."""
    poses = scene.points[0]
    values, vectors = ({name: v[rows] for name, v in named.items()} for named in (poses.values, poses.vectors))
    changed = replace(
        poses,
        xyz=poses.xyz[rows].copy(),
        q=poses.q[rows],
        labels=[poses.labels[row] for row in rows],
        values=values,
        vectors=vectors,
        fixture=[poses.fixture[row] for row in rows],
    )
    for row, what in missing.items():
        getattr(changed, what)[BEFORE][int(row[1:])] = np.nan
    return replace(scene, points=(changed,))


@needs_browser
def test_a_browser_draws_few_points_and_points_without_values(scene, tmp_path):
    """One pose; three, of which one has no position, one no vector and one no value; and two without any value."""
    lost = thinned_scene(scene, [0, 1, 2], r1="vectors", r2="values")
    lost.points[0].xyz[0] = np.nan
    none = thinned_scene(scene, [0, 1], r0="values", r1="values")
    for case, count, words in (
        (thinned_scene(scene, [0]), 1, ("mm", "mm")),
        (lost, 2, ("mm", "–")),
        (none, 2, ("–", "–")),
    ):
        probe = probed(tmp_path, AROUND.replace("PAGE", html.escape(render(make_page(60, scene=case)))))
        assert (probe["loaded"], probe["hidden"]) == (0, False)
        first, _, second, again = probe["seen"]
        assert (f"measured poses: 1 of {count}" in first["labels"]) == (count > 1)
        assert min(view["colours"] for view in (first, second, again)) > 100, "the arm is drawn"
        assert again["sum"] == first["sum"]
        shown = [re.search(rf"{BEFORE} (\S+) mm", view["readout"])[1] for view in (first, second)]
        assert [("–" if text == "–" else "mm") for text in shown] == list(words)[:2]
        assert not any(re.search("NaN|Infinity|undefined", text) for text in (*first["labels"], probe["scale"]))


def test_without_a_point_there_is_no_view(scene):
    nowhere = thinned_scene(scene, [0, 1])
    nowhere.points[0].xyz[:] = np.nan
    for empty in (nowhere, thinned_scene(scene, [])):
        page = render(make_page(60, scene=empty))
        assert page == render(make_page(60))
