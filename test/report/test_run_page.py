# SPDX-License-Identifier: Apache-2.0
"""The page of a run holds what the run holds, runs nothing but its own script, and needs nothing else."""

import hashlib
import json
import re
import sys
from base64 import b64decode
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.mechanics import relaxation
from tactile_resonance.cli import main
from tactile_resonance.frf.estimate import frf_of_record
from tactile_resonance.frf.result import BandDistortion
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.mechanics.indentation import Prony, Protocol
from tactile_resonance.report import point_details
from tactile_resonance.report.page import as_json, frf_entry, model_response, s_plane
from tactile_resonance.report.paper_figures import paper_figures
from tactile_resonance.report.point_details import MOST_DETAILED, detailed, lines_each
from tactile_resonance.report.run_report import as_page, warnings_of
from tactile_resonance.report.run_tables import distortion_table
from tactile_resonance.scan import tissue_tests
from tactile_resonance.scan.point_result import BandResult, PointOutcome, PointResult
from tactile_resonance.scan.run_content import RunContent, read_run
from tactile_resonance.scan.tissue_tests import fits_at

sys.path.insert(0, str(Path(__file__).resolve().parent))
from page_runs import BAND_HZ, HOSTILE, STATE_STEP_NS, scan, write_scene

from browser import browser

MB = 1e6


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A run of nine points, one of which failed, whose names are HTML; its folder and what was recorded."""
    folder = tmp_path_factory.mktemp("page")
    scene = write_scene(folder / "scene.yaml", name=HOSTILE, tissue=HOSTILE)
    recorded = scan(scene, folder / "run", failed=(4,))
    assert main(["report", str(folder / "run")]) == 0
    return folder / "run", recorded


def test_a_scene_that_cannot_be_read_is_named_with_the_reason(tmp_path):
    text = "force_n: 0.01\nsurface: {height_field: {file: gone.npz}}\npositions: {list: [[0, 0]]}\n"
    (tmp_path / "scene.yaml").write_text(text)
    told = warnings_of(RunContent(tmp_path, "", {}, ()))
    assert any("gone.npz" in line and "plan and outcome cannot be compared" in line for line in told)


class Page(HTMLParser):
    """Elements, attributes and scripts of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.loads, self.scripts, self.meta, self._script = [], [], {}, {}, None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.tags.append(tag)
        self.loads += [found[name] for name in ("src", "href", "srcset", "action") if name in found]
        assert not [name for name in found if name.startswith("on")]
        if tag == "script":
            self._script = found.get("id") or f"script {len(self.scripts)}"
            self.scripts[self._script] = ""
        if tag == "meta" and "http-equiv" in found:
            self.meta[found["http-equiv"]] = found["content"]

    def handle_endtag(self, tag):
        self._script = None if tag == "script" else self._script

    def handle_data(self, data):
        if self._script is not None:
            self.scripts[self._script] += data


def page_of(folder):
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def data_of(folder):
    return json.loads(page_of(folder).scripts["data"])


def test_the_data_of_the_page_are_those_of_the_run(hostile):
    folder, _ = hostile
    (run,) = data_of(folder)["runs"]
    results = read_run(folder).latest
    assert [p["index"] for p in run["bands"][0]["points"]] == [r.index for r in results]
    for point, result in zip(run["bands"][0]["points"], results, strict=True):
        assert point["outcome"] == result.outcome.name.lower()
        if result.failed:
            assert point["f0_hz"] is None
            assert point["re"] is None
            continue
        # to the last digit
        assert (point["f0_hz"], point["f0_std_hz"]) == (result.f0_hz, result.f0_std_hz)
        assert (point["damping"], point["damping_std"]) == (result.damping_ratio, result.damping_ratio_std)
        assert point["nominal_f0_hz"] == result.nominal_f0_hz
        assert (point["tissue"], point["probability"]) == (result.tissue_class, result.tissue_probability)
        assert point["x_mm"] == 1e3 * result.x_m
        assert point["force_mn"] == 1e3 * result.force_n
    surface = run["bands"][0]["surface"]
    assert np.shape(surface["f0_hz"]) == (len(surface["y_mm"]), len(surface["x_mm"]))


@pytest.mark.parametrize("dof", [1, 7, 0])
def test_bars_of_an_frf_hold_its_level_as_often_as_they_say(dof):
    """Of normal errors whose variance is estimated with so many degrees of freedom; 0: known."""
    rng, lines = np.random.default_rng(1), 20_000

    def noise(*shape):
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * np.sqrt(0.5)

    true, scale = np.exp(2j * np.pi * rng.random(lines)), 1e-3
    estimated = np.mean(np.abs(noise(dof, lines)) ** 2, axis=0) if dof else np.ones(lines)
    g = true + scale * noise(lines)
    message = SimpleNamespace(frequency_hz=np.arange(1.0, lines + 1), real=g.real, imag=g.imag)
    message.variance_total, message.total_dof = scale**2 * estimated, dof
    entry = frf_entry(message, None, lines)
    g, std = np.array(entry["re"]) + 1j * np.array(entry["im"]), np.array(entry["std"])
    half_db = 20 / np.log(10) * entry["bar_stds"] * std / np.abs(g)  # as page.js
    held = np.abs(20 * np.log10(np.abs(g))) <= half_db
    assert np.mean(held) == pytest.approx(0.95, abs=0.008)  # five standard deviations of the part


def test_a_click_shows_the_frf_that_was_recorded_and_the_model_that_was_identified(hostile):
    folder, recorded = hostile
    (run,) = data_of(folder)["runs"]
    assert set(run["details"]) == {str(index) for index in recorded}
    for index, (frf, poles) in recorded.items():
        detail = run["details"][str(index)]
        g = np.array(detail["frf"]["re"]) + 1j * np.array(detail["frf"]["im"])
        lines = np.isin(frf.frequency_hz, detail["frf"]["frequency_hz"])
        inside = (frf.frequency_hz >= BAND_HZ[0]) & (frf.frequency_hz <= BAND_HZ[1])
        assert np.all(lines[inside])
        np.testing.assert_allclose(g, frf.g[lines], rtol=1e-5, atol=1e-9)
        std = np.sqrt(frf.variance_noise[lines])
        np.testing.assert_allclose(detail["frf"]["std"], std, rtol=1e-5)
        (model,) = detail["frf"]["models"]
        at_hz = np.array(model["frequency_hz"])
        response = np.array(model["re"]) + 1j * np.array(model["im"])
        # messages hold the poles and residues; what they do not hold follows from the FRF within its noise
        off = np.abs(response - poles.fit.response(at_hz))
        assert np.max(off) < 5 * np.sqrt(np.max(frf.variance_noise[inside]))
        (pole,) = detail["poles"]
        assert complex(pole["re"], pole["im"]) == pytest.approx(complex(poles.poles_rad_s[0]), rel=1e-9)
        np.testing.assert_allclose(detail["force"]["t_s"], 1e-9 * STATE_STEP_NS * np.arange(10), atol=1e-6)
        np.testing.assert_allclose(detail["force"]["force_mn"][1], 10 + 0.1 * np.sin(1), rtol=1e-4)
        assert abs(detail["truth"]["f0_hz"] - pole["f0_hz"]) < 5 * pole["f0_std_hz"]


def test_the_model_with_the_poles_and_residues_of_a_fit_is_the_fit(hostile):
    _, recorded = hostile
    frf, poles = recorded[0]
    inside = (frf.frequency_hz >= BAND_HZ[0]) & (frf.frequency_hz <= BAND_HZ[1])
    lines = frf.frequency_hz[inside]
    exact = poles.fit.response(lines)
    at_hz = np.linspace(*BAND_HZ, 333)
    found = model_response(lines, exact, np.full(lines.size, np.nan), poles, at_hz)
    np.testing.assert_allclose(found, poles.fit.response(at_hz), rtol=1e-6)


def test_of_a_single_period_no_model_is_drawn(hostile):
    """Its FRF holds the transient, after which the polynomial beside the modes would bend."""
    frf, poles = hostile[1][0]
    message = SimpleNamespace(frequency_hz=frf.frequency_hz, real=frf.g.real, imag=frf.g.imag)
    message.variance_total, message.total_dof = frf.variance_noise, 7
    assert len(frf_entry(message, poles, 600)["models"]) == 1
    message.variance_total = message.variance_noise = np.empty(0)
    message.noise_dof = 0
    assert frf_entry(message, poles, 600)["models"] == []


def test_covariances_go_over_into_the_s_plane():
    rng = np.random.default_rng(3)
    at, std = np.array([250.0, 0.034]), np.array([0.02, 1e-4])
    covariance = np.outer(std, std) * [[1, 0.4], [0.4, 1]]
    drawn = rng.multivariate_normal(at, covariance, 200_000)
    w, z = 2 * np.pi * drawn[:, 0], drawn[:, 1]
    poles = -z * w + 1j * w * np.sqrt(1 - z**2)
    pole, slope = s_plane(*at)
    assert abs(np.mean(poles) - pole) < 4 * np.std(poles) / np.sqrt(len(poles))
    np.testing.assert_allclose(slope @ covariance @ slope.T, np.cov(poles.real, poles.imag), rtol=0.02)


def test_texts_of_a_run_are_texts_of_the_page(hostile):
    folder, _ = hostile
    page = page_of(folder)
    # three scripts: data, plotly.js, our own; no picture but the map
    assert page.tags.count("script") == 3
    assert page.tags.count("img") == 1
    assert set(page.scripts) == {"data", "script 1", "script 2"}
    (run,) = json.loads(page.scripts["data"])["runs"]
    assert run["name"] == HOSTILE
    assert HOSTILE in {point["tissue"] for point in run["bands"][0]["points"]}
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "<img src=x" not in text
    # plotly reads tags in names: figures made here have them escaped
    for figure in data_of(folder)["figures"]:
        assert not [t for t in figure["traces"] if "<" in t["name"]]


def test_json_of_the_page_cannot_end_its_element():
    text = as_json({"a": "</script><!--\u2028\u2029&"})
    assert "<" not in text
    assert text.isascii()
    assert json.loads(text) == {"a": "</script><!--\u2028\u2029&"}
    with pytest.raises(ValueError, match="not JSON compliant"):
        as_json({"a": float("nan")})


def test_the_page_loads_nothing_and_runs_nothing_else(hostile):
    folder, _ = hostile
    page = page_of(folder)
    assert [link[:22] for link in page.loads] == ["data:image/png;base64,"]
    policy = page.meta["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "connect-src 'none'" in policy
    allowed = {b64decode(each) for each in re.findall(r"'sha256-(.*?)'", policy)}
    own = {hashlib.sha256(t.encode()).digest() for name, t in page.scripts.items() if name != "data"}
    assert own == allowed
    styles = re.findall(r"<style>(.*?)</style>", (folder / "report.html").read_text(), re.DOTALL)
    assert styles
    assert not [s for s in styles if "url(" in s or "@import" in s]


def test_warnings_stand_first(hostile):
    folder, _ = hostile
    text = (folder / "report.html").read_text(encoding="utf-8")
    first = text.index('class="warnings"')
    assert first < text.index("points finished") < text.index('id="interactive"') < text.index("<h2>")
    told = warnings_of(read_run(folder))
    assert told[0] == "simulated, not measured"
    assert any(line.startswith("sensor health unknown") for line in told)
    assert any(line.startswith("failed, 1 of 9 points: 5 (lost") for line in told)
    damaged = folder / "recording/point-00000-00.mcap"
    content = damaged.read_bytes()
    try:
        damaged.write_bytes(content[:-100])
        told = warnings_of(read_run(folder))
    finally:
        damaged.write_bytes(content)
    assert told[1].startswith("damaged: point-00000-00.mcap")
    assert "1 of 9 points are not finished" in told


def test_a_file_of_a_version_that_cannot_be_read_costs_its_details_alone(hostile, monkeypatch):
    folder, _ = hostile
    run = read_run(folder)

    def refuse(*_):
        raise ValueError("point-00000-00.mcap: recorded by a version without the field instant_s")

    monkeypatch.setattr(point_details, "read_messages", refuse)
    details = point_details.details_of(run)
    told = warnings_of(run, None, details)
    problem = "cannot be read: point-00000-00.mcap: recorded"
    wanted = f"FRF, force or mechanical tests of {len(details)} points {problem}"
    assert wanted in " ".join(told)
    data = as_page(run, [], [], details, {})
    (entry,) = json.loads(Page(data).scripts["data"])["runs"]
    assert entry["bands"][0]["points"][0]["f0_hz"] == run.latest[0].f0_hz
    assert entry["details"]["0"]["frf"] is None


def test_a_point_off_its_force_is_named(hostile):
    folder, _ = hostile
    run = read_run(folder)
    assert not [line for line in warnings_of(run) if "force other than" in line]
    off = tuple(replace(r, force_n=0.012, force_std_n=1e-4) if r.index == 2 else r for r in run.results)
    (line,) = [t for t in warnings_of(replace(run, results=off)) if "force other than" in t]
    assert line == "force other than the scene's, 1 of 9 points: 3 (12.00 mN)"


def test_poles_of_a_further_band_with_a_remark_are_named(hostile):
    folder, _ = hostile
    run = read_run(folder)
    assert not [line for line in warnings_of(run) if "remark" in line]
    statuses = {1: "ok", 2: "model error", 3: "no resonance"}
    further = {k: (BandResult(600.0, 800.0, poles_status=status),) for k, status in statuses.items()}
    results = tuple(replace(r, further=further.get(r.index, ())) for r in run.results)
    (line,) = [t for t in warnings_of(replace(run, results=results)) if "remark" in t]
    told = "3 (600 to 800 Hz: model error), 4 (600 to 800 Hz: no resonance)"
    assert line == f"poles with a remark, 2 of 9 points: {told}"


def test_what_is_not_known_of_distortion_is_not_called_noise(hostile, monkeypatch):
    nan, band = np.nan, {"low_hz": 200.0, "high_hz": 300.0}
    cases = [
        BandDistortion(**band, even_db=-50.0, even_noise_db=-60.0, even_above_noise=True),
        BandDistortion(**band, even_db=-60.0, even_noise_db=-60.0),
        BandDistortion(**band, even_db=-11.4, even_noise_db=nan),  # of one block, from rest
        BandDistortion(**band),
    ]
    results = [PointResult(k, distortion=(of,)) for k, of in enumerate(cases)]
    rows = re.findall("<tr>(.*?)</tr>", distortion_table(results).split("<tbody>")[1])
    even = [re.findall("<td>(.*?)</td>", row)[2] for row in rows]
    assert even == ["-50.0 (-60.0)", "-60.0 (-60.0), only noise", "-11.4, noise unknown", "-"]
    monkeypatch.setattr("tactile_resonance.report.paper_figures.measurements_of_file", lambda _: [])
    run = replace(read_run(hostile[0]), results=tuple(results))
    (figure,) = [f for f in paper_figures(run, {}) if "figure 6" in f["title"]]
    assert "Points with more than noise, of 4: even 1, odd 0. Noise is unknown at 2." in figure["note"]
    assert [t["name"] for t in figure["traces"][::2]] == ["even lines", "odd lines"]

    def refuse(_):
        raise ValueError("measurement 7: of no realisation all periods are there")

    monkeypatch.setattr("tactile_resonance.report.paper_figures.measurements_of_file", refuse)
    (output,) = [f for f in paper_figures(run, {}) if f["title"].startswith("Output and its distortion")]
    assert output["note"] == "Left out: measurement 7: of no realisation all periods are there."


def test_an_frf_that_failed_leaves_its_figure_out_and_no_more(hostile):
    """Its arrays are empty, as of a reference in air with faults."""
    empty = {name: np.empty(0) for name in ("frequency_hz", "real", "imag", "variance_noise", "variance_total")}
    run = read_run(hostile[0])
    details = {r.index: point_details.PointDetails(frf=SimpleNamespace(**empty)) for r in run.latest}
    (figure,) = [f for f in paper_figures(run, details) if "(figure 5)" in f["title"]]
    assert (figure["traces"], figure["note"].startswith("Left out: the recording holds no FRF")) == ([], True)


def test_figures_of_the_paper_that_a_run_cannot_give_say_why(hostile):
    folder, _ = hostile
    figures = {re.search(r"\((.*)\)$", f["title"])[1]: f for f in data_of(folder)["figures"]}
    assert set(figures) == {"figure 5", "figures 5 and 6", "figure 8", "figure 9"}
    assert figures["figures 5 and 6"]["traces"] == []
    assert "distortion is not among the outputs" in figures["figures 5 and 6"]["note"]
    for name in ("figure 5", "figure 8", "figure 9"):
        assert figures[name]["traces"], name
    assert "preparations" in figures["figure 9"]["note"]


def test_noise_over_periods_is_that_of_one_period(hostile):
    folder, recorded = hostile
    (figure,) = [f for f in data_of(folder)["figures"] if "figure 9" in f["title"]]
    classes = Counter(r.tissue_class for r in read_run(folder).latest if r.index in recorded)
    name, count = classes.most_common(1)[0]
    frfs = [recorded[r.index][0] for r in read_run(folder).latest if r.tissue_class == name]
    assert count >= 4
    assert figure["note"].startswith(name)
    mean, positions, periods = figure["traces"]
    assert [t["name"].split(" (")[0] for t in (positions, periods)] == ["positions", "periods"]
    inside = np.isin(np.round(frfs[0].frequency_hz, 6), np.round(mean["x"], 6))
    # of the mean of four periods the variance is a fourth of that of one
    one_period = 4 * np.mean([f.variance_noise for f in frfs], axis=0)
    np.testing.assert_allclose(periods["y"], 10 * np.log10(one_period[inside]), atol=1e-3)
    scatter = np.var([f.g for f in frfs], axis=0, ddof=1)
    np.testing.assert_allclose(positions["y"], 10 * np.log10(scatter[inside]), atol=1e-3)


def test_noise_over_periods_is_that_of_one_period_of_several_realisations_too(hostile):
    """Two points of three realisations of four periods each: variance of the FRFs of single periods."""
    rng, (folder, _), frfs, scatter = np.random.default_rng(1), hostile, [], []
    for _ in range(2):
        lines = np.arange(1, 200)
        phases = np.exp(2j * np.pi * rng.uniform(size=(3, 1, 199)))
        u = np.tile(np.fft.irfft(20 * np.pad(phases, ((0, 0), (0, 0), (1, 1)))), (1, 4, 1))
        y = u + 0.1 * rng.standard_normal(u.shape)
        frf = frf_of_record(Spectrum.of(u, y), lines, sample_rate_hz=400.0, method="average")
        of = {"real": frf.g.real, "imag": frf.g.imag, "periods": frf.periods, "realisations": 3}
        names = ("frequency_hz", "variance_noise", "variance_total")
        frfs.append(SimpleNamespace(**of, **{name: getattr(frf, name) for name in names}))
        used = (np.fft.rfft(y)[..., lines] / np.fft.rfft(u)[..., lines])[:, -frf.periods :]
        scatter.append(np.var(used, axis=1, ddof=1).mean(axis=0))
    run = read_run(folder)
    name, _ = Counter(r.tissue_class for r in run.latest if not r.failed).most_common(1)[0]
    two = [r.index for r in run.latest if r.tissue_class == name][:2]
    details = {k: point_details.PointDetails(frf=frf) for k, frf in zip(two, frfs, strict=True)}
    (figure,) = [f for f in paper_figures(run, details) if "(figure 9)" in f["title"]]
    periods = next(t for t in figure["traces"] if t["name"].startswith("periods"))
    level_db = 10 * np.log10(np.mean(scatter, axis=0))
    assert np.mean(np.subtract(periods["y"], level_db)) == pytest.approx(0, abs=0.5)


def test_large_runs_keep_few_details_and_say_so():
    many = [PointResult(k, measurement_id=k + 1) for k in range(10_000)]
    chosen = detailed(many)
    assert len(chosen) == MOST_DETAILED
    assert chosen[0] is many[0]
    assert chosen[-1] is many[-1]
    assert np.ptp(np.diff([r.index for r in chosen])) <= 1
    # lines of all points together are bounded too
    assert lines_each(25) == 600
    assert lines_each(MOST_DETAILED) * MOST_DETAILED <= 60_000
    assert detailed([PointResult(0, outcome=PointOutcome.FAILED, measurement_id=1)]) == []


def test_the_page_shows_a_point_without_an_error(hostile):
    folder, _ = hostile
    address = (folder / "report.html").as_uri()
    with browser() as page:
        page.show(f"{address}#point=4", "document.querySelector('h2')?.textContent === 'point 4'")
        # map, FRF, s-plane, force, three figures
        page.wait("document.querySelectorAll('.js-plotly-plot').length === 7")
        assert page.value("document.querySelectorAll('script').length") == 3
        assert page.value("document.querySelectorAll('img').length") == 1
        assert "no FRF of this point" not in page.value("document.body.innerText")
        # a click on the place of another point
        place = """(() => {
            const plot = document.querySelector('.js-plotly-plot'), box = plot.getBoundingClientRect();
            const at = axis => axis.l2p(10) + axis._offset;
            return [box.x + at(plot._fullLayout.xaxis), box.y + at(plot._fullLayout.yaxis)];
        })()"""
        page.move(*page.value(place), click=True)
        page.wait("document.querySelector('h2').textContent === 'point 9'")
        # and on the row of a third
        page.value("document.querySelector('tr[data-point=\"1\"]').click()")
        page.wait("document.querySelector('h2').textContent === 'point 2'")
        assert page.paper().startswith(b"%PDF")
        assert page.console == []
        assert {each.partition("#")[0] for each in page.requests} == {address}


def test_a_page_of_nothing_and_of_failures_alone_opens(tmp_path):
    scene = write_scene(tmp_path / "scene.yaml")
    scan(scene, tmp_path / "begun", most=0)
    scan(scene, tmp_path / "failed", most=2, failed=(0, 1))
    with browser() as page:
        for name, heading in (("begun", ""), ("failed", "point 1")):
            assert main(["report", str(tmp_path / name)]) == 0
            address = (tmp_path / name / "report.html").as_uri()
            page.show(address, f"document.querySelector('#interactive h2')?.textContent === '{heading}'")
        assert "no FRF of this point" in page.value("document.body.innerText")
        assert page.console == []


def test_the_page_of_a_usual_run_is_small(hostile):
    folder, _ = hostile
    assert (folder / "report.html").stat().st_size < 8 * MB


REFUSED = f"relaxation: contact: refused {HOSTILE}"


@pytest.fixture(scope="module")
def tested(tmp_path_factory):
    """Four points: two tests, one that was refused, one that cannot be fitted, none; the page is written."""
    folder = tmp_path_factory.mktemp("tested")
    scene = write_scene(folder / "scene.yaml", tissue=HOSTILE)
    asked = "{kind: relaxation, hold_s: 8, points: [1, 2, 3]}, {kind: creep, hold_s: 8, points: [1]}"
    scene.write_text(scene.read_text() + f"\nprotocols: [{asked}]\n")
    rng = np.random.default_rng(5)
    good = relaxation(Prony(3e3, np.array([2e3]), np.array([1.5])), rng, hold_s=8.0, noise_n=5e-5)
    slow = Prony(3e3, np.array([2e3, 2e3]), np.array([0.8, 60.0]))
    other = replace(relaxation(slow, rng, hold_s=8.0, noise_n=5e-5), protocol=Protocol.CREEP)
    begun = good.time_s > 1.0  # in contact
    cut = {name: getattr(good, name)[begun] for name in ("time_s", "force_n", "depth_m")}
    tests = {0: (good, other), 2: (replace(good, **cut),)}
    scan(scene, folder / "run", most=4, tests=tests, reasons={1: REFUSED})
    assert main(["report", str(folder / "run")]) == 0
    return folder / "run"


def test_the_page_holds_the_fits_of_mechanical_tests(tested):
    run = read_run(tested)
    (entry,) = data_of(tested)["runs"]
    assert entry["tested"] == 2
    assert [len(entry["details"][str(k)]["tests"]) for k in range(4)] == [2, 0, 1, 0]
    found = fits_at(run, run.latest[0])
    assert [one.test.protocol for one in found] == [Protocol.RELAXATION, Protocol.CREEP]
    for shown, one in zip(entry["details"]["0"]["tests"], found, strict=True):
        curve = shown.pop("curve")
        assert shown == json.loads(json.dumps(one.as_json()))  # to the last digit
        kept = np.searchsorted(one.fit.time_s, np.array(curve["t_s"]) - 1e-4)
        assert 50 < kept.size <= 160
        assert (kept[0], kept[-1]) == (0, one.fit.time_s.size - 1)
        for name, values in (
            ("t_s", one.fit.time_s),
            ("measured_mn", 1e3 * one.fit.measured_n),
            ("model_mn", 1e3 * one.fit.force_n),
            ("depth_mm", 1e3 * one.fit.indentation_m),
        ):
            np.testing.assert_allclose(curve[name], values[kept], rtol=2e-5, atol=1e-9)
    # the hold of 8 s shows a term of 1.5 s, and not one of 60 s
    knowns = [[t["known"] for t in test["terms"]] for test in entry["details"]["0"]["tests"]]
    assert knowns[0] == ["determined"]
    assert "not determined: slower than the hold" in knowns[1]
    (unfitted,) = entry["details"]["2"]["tests"]
    assert unfitted["curve"] is None
    assert "a record that begins before the touch" in unfitted["reason"]


def test_mechanical_tests_that_failed_are_a_warning(tested, hostile):
    run = read_run(tested)
    (line,) = [w for w in warnings_of(run, None, point_details.details_of(run)) if "mechanical" in w]
    wanted = f"mechanical test failed, 2 of 4 points: 2 ({REFUSED}), 3 (relaxation: depth_m: got "
    assert line.startswith(wanted)
    assert not [w for w in warnings_of(read_run(hostile[0])) if "mechanical" in w]


def test_a_test_that_cannot_be_read_costs_itself_alone(tested, monkeypatch):
    why = "depth_m: got -1.0; accepted is a largest one above 0"

    def refuse(message, label):
        raise ValueError(why)

    monkeypatch.setattr(tissue_tests, "indentation_from_message", refuse)
    run = read_run(tested)
    details = point_details.details_of(run)
    assert [details[k].tests for k in (0, 2)] == [(), ()]
    assert details[0].frf is not None
    (line,) = [w for w in warnings_of(run, None, details) if "cannot be read" in w]
    assert line == f"FRF, force or mechanical tests of 2 points cannot be read: {why}"


def test_many_mechanical_tests_are_thinned_out_and_the_page_says_so(tested, monkeypatch):
    monkeypatch.setattr(point_details, "MOST_TESTED", 1)
    run = read_run(tested)
    details = point_details.details_of(run)
    assert [index for index, each in details.items() if each.tests] == [0]
    assert set(details) == {0, 1, 2, 3}
    data = json.loads(Page(as_page(run, [], [], details, {})).scripts["data"])
    assert "Mechanical tests of 1 of 2 points are in this page." in data["note"]


def test_a_click_shows_mechanical_tests_where_a_run_has_some(tested, hostile):
    drawn = "document.querySelectorAll('.js-plotly-plot').length"
    text = "document.querySelector('.two > :last-child').innerText"
    with browser() as page:
        address = (tested / "report.html").as_uri()
        page.show(f"{address}#point=1", "document.querySelectorAll('.two h3').length === 2")
        shown = page.value(text)
        assert "mechanical tests: means of the force" in shown
        run = read_run(tested)
        for one in fits_at(run, run.latest[0]):
            value, std = one.fit.modulus(1.0)
            assert f"{value:.0f} Pa" in shown
            assert f"± {100 * std:#.2g} %" in shown
        assert "not determined: slower than the hold" in shown
        for point, wanted in ((3, "not fitted: depth_m"), (4, "no mechanical test of this point")):
            page.value(f"document.querySelector('tr[data-point=\"{point - 1}\"]').click()")
            page.wait(f"document.querySelector('h2').textContent === 'point {point}'")
            assert wanted in page.value(text)
        assert page.value("document.querySelectorAll('script').length") == 3
        page.show((hostile[0] / "report.html").as_uri(), f"{drawn} === 7")
        assert "mechanical" not in page.value("document.body.innerText")
        assert page.console == []
