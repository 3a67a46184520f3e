# SPDX-License-Identifier: Apache-2.0
"""The analyze command as a user meets it: a process, its streams, its files."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import tactile_resonance as tr
from tactile_resonance import cli
from tactile_resonance.multisine import design_multisine
from tactile_resonance.record import SIMULATED
from tactile_resonance.report.drawing import draw_analysis

F0_HZ, DAMPING, RATE_HZ, N = 250.0, 0.03, 5000.0, 2000


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "tactile_resonance.cli", "analyze", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
    )


def record(periods=6, noise=1e-3, seed=0):
    excitation = design_multisine(
        sample_rate_hz=RATE_HZ, samples_per_period=N, band_hz=(100, 400), level_v=1.0, seed=seed
    )
    s = 2j * np.pi * excitation.frequency_hz
    w0 = 2 * np.pi * F0_HZ
    g = 0.02 + 100 * s / (s**2 + 2 * DAMPING * w0 * s + w0**2)
    spectrum = excitation.spectrum()
    spectrum[excitation.harmonics] *= g
    rng = np.random.default_rng(seed)
    u = np.tile(excitation.period(), periods)
    y = np.tile(np.fft.irfft(spectrum * N, N), periods) + noise * rng.standard_normal(periods * N)
    return {"u": u, "y": y, "sample_rate_hz": RATE_HZ, "samples_per_period": N}


@pytest.fixture
def good(tmp_path):
    path = tmp_path / "good.npz"
    np.savez(path, **record())
    return path


@pytest.mark.parametrize("notes", [(), (SIMULATED,)])
def test_a_figure_of_a_simulated_record_says_so(notes):
    recording = replace(tr.make_recording(**record()), notes=notes)
    figure = draw_analysis(tr.analyse(recording, band_hz=(200.0, 300.0)), "title")
    assert figure.get_suptitle() == ("title (simulated, not measured)" if notes else "title")


def test_json_and_figure_of_a_record(good, tmp_path):
    out, figure = tmp_path / "out.json", tmp_path / "out.png"
    answer = run(good, "--band", 200, 300, "--json", out, "--plot", figure)
    assert answer.returncode == 0, answer.stderr
    assert "mode: f0 " in answer.stdout
    content = json.loads(out.read_text())
    pole = content["poles"][0]
    covariance = np.array(pole["covariance"])
    assert abs(pole["f0_hz"] - F0_HZ) < 4 * np.sqrt(covariance[0, 0])
    assert abs(pole["damping_ratio"] - DAMPING) < 4 * np.sqrt(covariance[1, 1])
    assert np.hypot(pole["real_rad_s"], pole["imag_rad_s"]) == pytest.approx(
        2 * np.pi * pole["f0_hz"]
    )
    assert set(content) >= {
        "frf",
        "poles",
        "cost",
        "expected_cost",
        "status",
        "warnings",
        "timing_s",
    }
    frf = content["frf"]
    assert len({len(frf[key]) for key in ("frequency_hz", "real", "imag", "variance")}) == 1
    assert frf["frequency_hz"][0] == 100.0
    assert content["status"] == "ok"
    assert pole["f0_drift_hz_per_s"] is content["instant_s"] is None
    assert figure.read_bytes()[:4] == b"\x89PNG"


def test_the_data_choose_the_orders(tmp_path, capsys):
    """Of one mode alone one is chosen, of two 6 Hz apart both, where one alone is a model error."""
    one, two = record(), record()
    late = 2 * np.pi * 256.0
    time_s = np.arange(N) / RATE_HZ
    kernel = np.exp(-DAMPING * late * time_s) * np.cos(late * time_s) * 60 / RATE_HZ
    settled = np.fft.irfft(np.fft.rfft(kernel) * np.fft.rfft(two["u"][:N]), N)
    two["y"] = two["y"] + np.tile(settled, 6)
    for content, order in ((one, 2), (two, 4)):
        path, out = tmp_path / f"{order}.npz", tmp_path / f"{order}.json"
        np.savez(path, **content)
        common = ["analyze", str(path), "--band", "200", "300", "--json", str(out)]
        assert cli.main([*common, "--order", "auto"]) == 0
        chosen = json.loads(out.read_text())
        assert (chosen["order"], chosen["status"]) == (order, "ok")
        assert "chosen by description length from 9" in capsys.readouterr().out
        f0_hz = [pole["f0_hz"] for pole in chosen["poles"]]
        assert f0_hz == pytest.approx([250.0, 256.0][: order // 2], abs=0.2)
        assert cli.main(common) == 0
        assert json.loads(out.read_text())["status"] == ("ok" if order == 2 else "model error")
        capsys.readouterr()


def test_a_mode_that_changes_is_reported_with_its_drift(tmp_path, capsys):
    """f0 rises by .02 Hz from period to period, each of them settled."""
    content = record()
    spectrum = np.fft.rfft(content["u"][:N])
    s = 2j * np.pi * np.arange(spectrum.size) * RATE_HZ / N
    rng = np.random.default_rng(3)
    periods = []
    for k in range(6):
        w0 = 2 * np.pi * (F0_HZ + 0.02 * (k - 2.5))
        g = 0.02 + 100 * s / (s**2 + 2 * DAMPING * w0 * s + w0**2)
        periods.append(np.fft.irfft(spectrum * g, N) + 1e-3 * rng.standard_normal(N))
    path, out = tmp_path / "creeps.npz", tmp_path / "out.json"
    np.savez(path, **{**content, "y": np.concatenate(periods)})
    assert cli.main(["analyze", str(path), "--band", "200", "300", "--json", str(out)]) == 0
    assert "changes: f0 by 0.0" in capsys.readouterr().out
    content = json.loads(out.read_text())
    pole = content["poles"][0]
    assert content["instant_s"] == pytest.approx(1.2, abs=1e-3)
    assert pole["f0_drift_hz_per_s"] == pytest.approx(0.05, rel=0.1)
    assert abs(pole["damping_drift_per_s"]) < 1e-5
    assert 0 < np.sqrt(pole["drift_covariance"][0][0]) < 0.005


def test_band_is_found_when_none_is_given(good, capsys):
    assert cli.main(["analyze", str(good)]) == 0
    printed = capsys.readouterr().out
    assert "band: chosen around the strongest resonance" in printed
    assert re.search(r"mode: f0 2(50\.0|49\.9)", printed)


def damaged(**changes):
    content = record() | changes
    return {key: value for key, value in content.items() if value is not None}


BAD = {
    "missing sensor": (
        damaged(y=None),
        (),
        "y (--y): got 'y'; accepted is an array of numbers in bad.npz, which holds",
    ),
    "text": (
        damaged(u=np.full(6 * N, "1.5")),
        (),
        "u (--u): no numbers under 'u' in bad.npz, expected an array of them",
    ),
    "nothing": ({}, (), "accepted is an array of numbers in bad.npz, which holds nothing"),
    "nan": (damaged(y=np.full(6 * N, np.nan)), (), "y (--y): 12000 samples are NaN or infinite"),
    "constant": (damaged(u=np.ones(6 * N)), (), "u (--u): constant (1 V)"),
    "one period": (
        damaged(samples_per_period=6 * N),
        (),
        "(samples_per_period, --samples-per-period, is their length)",
    ),
    "narrow band": (damaged(), ("--band", 249, 251), "holds 1 excited lines"),
    "band beside the lines": (damaged(), ("--band", 1200, 1300), "excited are lines from "),
    "delay in ms": (damaged(), ("--channel-delay", 3.3), "accepted is up to half a period, 0.2 s"),
    "half a period": (damaged(), ("--samples-per-period", 1000), "1000, but u repeats after 2000"),
    "band reversed": (damaged(), ("--band", 300, 200), "band_hz (--band): got [300.0, 200.0]"),
    "no rate": (damaged(sample_rate_hz=None), (), "sample_rate_hz (--sample-rate): missing"),
    "zero rate": (damaged(sample_rate_hz=0.0), (), "sample_rate_hz (--sample-rate): got 0.0"),
    "zero rate option": (
        damaged(),
        ("--sample-rate", 0),
        "sample_rate_hz (--sample-rate): got 0.0",
    ),
    "broken period": (damaged(samples_per_period=1999), (), "expected a multiple of the period"),
    "order": (damaged(), ("--order", -1), "order (--order): -1"),
    "orders": (
        damaged(),
        ("--order", "auto", "--numerator-order", 7),
        "numerator_order (--numerator-order): got",
    ),
    "output folder": (damaged(), ("--json", "/nonexistent/out.json"), "--json: got '/nonexistent"),
    "measurement": (damaged(), ("--measurement", 3), "measurement_id (--measurement): got 3; accepted is none"),
    "period": (
        damaged(),
        ("--samples-per-period", 3),
        "samples_per_period (--samples-per-period): got",
    ),
    "periods": (
        damaged(),
        ("--periods", 0),
        "periods (--periods): got 0; accepted is a whole number",
    ),
    "segments": (damaged(), ("--segments", "5:3"), "segments (--segments): 5:3, expected"),
    "lines": (damaged(), ("--harmonics", "1:1000"), "excited_harmonics (--harmonics): "),
    "figure kind": (damaged(), ("--plot", "out.docx"), "--plot: got 'out.docx"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gives_one_line_and_no_file(case, tmp_path, capsys):
    content, options, message = BAD[case]
    path, out = tmp_path / "bad.npz", tmp_path / "out.json"
    np.savez(path, **content)
    if "--json" not in options:
        options = (*options, "--json", out)
    assert cli.main(["analyze", str(path), *map(str, options)]) != 0
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1, printed.err
    assert message in printed.err
    assert list(tmp_path.iterdir()) == [path]


def test_unknown_options_are_told_in_one_line(capsys):
    for arguments in (["analyze"], ["analyze", "a.npz", "--band", "1"], ["analyse"], []):
        with pytest.raises(SystemExit, match="2"):
            cli.main(arguments)
        printed = capsys.readouterr().err
        assert printed.count("\n") == 1
        assert printed.startswith("tactile_resonance: ")


def test_distortion_of_the_silverbox(shared_data, tmp_path, capsys):
    """Even-line output about -48 dB (reference page of the data), in text, JSON and figure."""
    ends = [48946, 57646, 66346, 75046, 83746, 92396, 101096, 109796, 118496, 127196]
    out, plot = tmp_path / "out.json", tmp_path / "out.png"
    arguments = [
        *("analyze", shared_data / "silverbox" / "SNLS80mV.mat", "--u", "V1", "--y", "V2"),
        *("--sample-rate", 610.3515625, "--samples-per-period", 8192, "--band", 40, 110),
        *("--segments", ",".join(f"{end - 8192}:{end}" for end in ends), "--distortion"),
        *("--json", out, "--plot", plot),
    ]
    assert cli.main([str(argument) for argument in arguments]) == 0
    assert "Even lines: output -48." in capsys.readouterr().out
    even = json.loads(out.read_text())["distortion"]["even"]
    assert even["rms_output_level_db"] == pytest.approx(-48, abs=1)
    assert len(even["level_db"]) == len(even["frequency_hz"]) > 1000
    assert (tmp_path / "out_distortion.png").read_bytes()[:4] == b"\x89PNG"


def test_silverbox_as_the_issue_of_a_user(shared_data, tmp_path):
    """Reference: f0 69.536 +- 0.012 Hz, damping ratio 0.04877 +- 0.00016."""
    ends = [48946, 57646, 66346, 75046, 83746, 92396, 101096, 109796, 118496, 127196]
    answer = run(
        shared_data / "silverbox" / "SNLS80mV.mat",
        *("--u", "V1", "--y", "V2", "--sample-rate", 610.3515625, "--samples-per-period", 8192),
        *("--segments", ",".join(f"{end - 8192}:{end}" for end in ends)),
        *("--band", 40, 110, "--json", tmp_path / "out.json"),
    )
    assert answer.returncode == 0, answer.stderr
    pole = json.loads((tmp_path / "out.json").read_text())["poles"][0]
    assert abs(pole["f0_hz"] - 69.536) < 3 * 0.012
    assert abs(pole["damping_ratio"] - 0.04877) < 3 * 0.00016


@pytest.mark.parametrize(
    "options", [(), ("--method", "frf"), ("--frf", "average", "--method", "frf")]
)
@pytest.mark.parametrize("domain", ["s", "z"])
def test_every_method_agrees_with_the_truth(options, domain, tmp_path, capsys):
    """A record from rest: the transient is in it."""
    content = record(periods=8, noise=2e-3, seed=4)
    w0 = 2 * np.pi * F0_HZ
    pole = w0 * (-DAMPING + 1j * np.sqrt(1 - DAMPING**2))
    time_s = np.arange(8 * N) / RATE_HZ
    content["y"] = content["y"] + 0.3 * np.real(np.exp(pole * time_s + 0.7j))
    np.savez(tmp_path / "a.npz", **content)
    out = tmp_path / "out.json"
    arguments = ["analyze", str(tmp_path / "a.npz"), "--band", "200", "300", "--domain", domain]
    assert cli.main([*arguments, *options, "--json", str(out)]) == 0
    found = json.loads(out.read_text())["poles"][0]
    std = np.sqrt(np.diag(found["covariance"]))
    assert abs(found["f0_hz"] - F0_HZ) < 4 * std[0]
    assert abs(found["damping_ratio"] - DAMPING) < 4 * std[1]
    assert std[0] < 0.05


@pytest.mark.parametrize(
    ("options", "realisations", "estimator"),
    [
        ((), 1, "joint maximum likelihood of poles and transient"),
        ((), 2, "joint maximum likelihood of poles and transients, 2 realisations"),
        (("--method", "frf"), 1, "weighted least squares"),
        (("--channel-delay", "1e-6"), 1, "weighted least squares"),
    ],
)
def test_the_estimator_is_named(options, realisations, estimator, tmp_path, capsys):
    """To a reader as in the JSON: which one it was is the program's choice where nobody made it."""
    parts = [record(periods=2, seed=seed) for seed in range(realisations)]
    channels = {
        name: np.stack([part[name] for part in parts]).reshape(realisations, 2, N) for name in "uy"
    }
    path, out = tmp_path / "a.npz", tmp_path / "out.json"
    np.savez(path, **{**parts[0], **channels})
    arguments = ["analyze", str(path), "--band", "200", "300", "--json", str(out), *options]
    assert cli.main(arguments) == 0
    (fit,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("fit: "))
    assert fit.startswith(f"fit: {estimator}, 41 lines, 200-300 Hz, orders 7/2, cost ")
    assert json.loads(out.read_text())["method"] == estimator


@pytest.mark.parametrize("periods", [1, 3])
def test_transients_of_several_realisations_do_no_harm(periods, tmp_path, capsys):
    """Each begins with a decay of its own, far above the noise, of which their mean FRF keeps some."""
    parts = [record(periods=periods, noise=1e-3, seed=m) for m in range(3)]
    content = {**parts[0]}
    w0 = 2 * np.pi * F0_HZ
    decay = np.exp(
        w0 * (-DAMPING + 1j * np.sqrt(1 - DAMPING**2)) * np.arange(periods * N) / RATE_HZ
    )
    transients = [np.real(decay * np.exp(2j * m)) for m in range(3)]
    content["u"] = np.stack([part["u"] for part in parts]).reshape(3, periods, N)
    y = np.stack([part["y"] + more for part, more in zip(parts, transients, strict=True)])
    content["y"] = y.reshape(3, periods, N)
    np.savez(tmp_path / "a.npz", **content)
    out = tmp_path / "out.json"
    arguments = ["analyze", str(tmp_path / "a.npz"), "--band", "200", "300", "--json", str(out)]
    assert cli.main(arguments) == 0
    answer = json.loads(out.read_text())
    assert answer["method"] == "joint maximum likelihood of poles and transients, 3 realisations"
    assert answer["status"] == "ok"
    found = answer["poles"][0]
    std = np.sqrt(np.diag(found["total_covariance"]))
    assert abs(found["f0_hz"] - F0_HZ) < 4 * std[0]
    assert abs(found["damping_ratio"] - DAMPING) < 4 * std[1]
    assert cli.main([*arguments, "--method", "frf"]) == 0
    from_frf = json.loads(out.read_text())["poles"][0]
    assert np.sqrt(from_frf["covariance"][0][0]) > 5 * std[0]


def test_a_known_channel_delay_is_taken_out(tmp_path, capsys):
    """Half a sample of skew bends the poles by far more than their uncertainty; known, it does no harm."""
    content = record(periods=8, noise=1e-4)
    spectrum = np.fft.rfft(content["y"])
    f = np.fft.rfftfreq(content["y"].size, 1 / RATE_HZ)
    delay_s = 0.5 / RATE_HZ
    content["y"] = np.fft.irfft(spectrum * np.exp(-2j * np.pi * f * delay_s), content["y"].size)
    path, out = tmp_path / "a.npz", tmp_path / "out.json"
    np.savez(path, **content)
    common = ["analyze", str(path), "--band", "200", "300", "--json", str(out)]
    arguments = [*common, "--numerator-order", "2"]

    def error():
        pole = json.loads(out.read_text())["poles"][0]
        return (pole["damping_ratio"] - DAMPING) / np.sqrt(pole["covariance"][1][1])

    assert cli.main([*arguments, "--channel-delay", str(delay_s)]) == 0
    assert abs(error()) < 4
    assert cli.main([*arguments, "--method", "frf"]) == 0
    assert abs(error()) > 10
    assert cli.main([*arguments, "--method", "joint", "--channel-delay", "1e-6"]) == 1
    assert "joint takes no channel delay" in capsys.readouterr().err


def test_outputs_never_replace_what_they_must_not(good, tmp_path, capsys):
    before = good.read_bytes()
    fifo = tmp_path / "device"
    os.mkfifo(fifo)
    for options, message in (
        (["--json", good], "accepted is a file that ends in .json"),
        (["--json", fifo], "accepted is a new file, or a regular one to replace"),
        (["--json", tmp_path], "accepted is a new file, or a regular one to replace"),
        (["--plot", good], "accepted is a file that ends in .png, .pdf, .svg"),
    ):
        assert cli.main(["analyze", str(good), *map(str, options)]) == 1
        printed = capsys.readouterr()
        assert message in printed.err
        assert printed.out == ""
    for options in (["--force", 0.01], ["--from-rest"], ["--relaxed-ratio", 1.2]):
        assert cli.main(["analyze", str(good), *map(str, options)]) == 1
        assert "accepted is one beside --calibration" in capsys.readouterr().err
    assert good.read_bytes() == before
    assert fifo.is_fifo()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["device", "good.npz"]


def test_lines_without_input_are_null(tmp_path, capsys):
    content = record(noise=1e-3)
    content["excited_harmonics"] = np.arange(20, 160)  # 40..160 are excited, at 2.5 Hz
    spectrum = np.fft.rfft(content["u"].reshape(6, N), axis=-1)
    spectrum[:, :40] = 0
    content["u"] = np.fft.irfft(spectrum, N).ravel()
    content["u"] -= content["u"].mean()
    path, out = tmp_path / "a.npz", tmp_path / "out.json"
    np.savez(path, **content)
    assert cli.main(["analyze", str(path), "--band", "200", "300", "--json", str(out)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "lines" in printed.out
    assert json.loads(out.read_text())["frf"]["frequency_hz"][0] == 50.0


@pytest.mark.parametrize("method", ["joint", "frf"])
@pytest.mark.parametrize("through", [0.0, 1.0], ids=["noise alone", "a flat system"])
def test_noise_is_not_taken_for_a_resonance(tmp_path, capsys, method, through):
    """Of ten records without any resonance none gives a pole (one in 10 000 is allowed to)."""
    path, out = tmp_path / "a.npz", tmp_path / "out.json"
    for seed in range(10):
        content = record(periods=6, seed=seed)
        noise = 0.1 * np.random.default_rng(100 + seed).standard_normal(6 * N)
        content["y"] = through * content["u"] + noise
        np.savez(path, **content)
        arguments = ["analyze", str(path), "--band", "200", "300", "--method", method]
        assert cli.main([*arguments, "--json", str(out)]) == 0
        found = json.loads(out.read_text())
        assert found["status"] in ("no resonance", "not converged"), (seed, found["poles"])
        assert all(pole["covariance"] is None for pole in found["poles"])


def test_excited_harmonics_may_be_given(tmp_path, capsys):
    """A disturbance as strong as the lines hides some from the finder; the file's own lose."""
    content = record(noise=1e-4)
    path = tmp_path / "record.npz"
    np.savez(path, **content, excited_harmonics=np.arange(40, 161, 3))
    for harmonics, lines in (
        ("40,41:160", "121 lines, 100-400 Hz"),
        ("41:160:2", "60 lines, 102.5-397.5 Hz"),
    ):
        arguments = ["analyze", str(path), "--band", "200", "300", "--harmonics", harmonics]
        assert cli.main(arguments) == 0
        assert f"FRF: {lines}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ("5:3", "expected H or FIRST:LAST"),
        ("0:3", "1 <= FIRST"),
        ("1:9:0", "STEP >= 1"),
        ("1:2:3:4", "FIRST:LAST:STEP"),
        ("7,", "expected H"),
        ("3.5", "expected H"),
        ("1:999999999999", "LAST <= 10000000"),
        ("1:1000", "expected whole numbers from 1 to 999"),
    ],
)
def test_wrong_harmonics_are_refused(good, given, reason, capsys):
    assert told([str(good), "--harmonics", given]) != 0
    assert reason in capsys.readouterr().err


def told(arguments):
    """Exit status, also where the options cannot be read."""
    try:
        return cli.main(["analyze", *arguments])
    except SystemExit as ended:
        return ended.code


def test_lines_that_are_not_named_leave_no_cost(good, capsys):
    """Every other line named: what else is excited counts as a disturbance, of which no cost follows."""
    assert cli.main(["analyze", str(good), "--band", "200", "300", "--harmonics", "40:160:2"]) == 0
    printed = capsys.readouterr().out
    assert "all bins as excitation" in printed
    assert "no cost (noise known from the residuals alone)" in printed
    assert "nan" not in printed


def test_a_good_record_from_rest_has_no_note_but_that_of_its_lines(tmp_path, capsys):
    """Its first period has not settled and its phase turns at the mode: neither needs attention."""
    content = record(periods=4)
    time_s = np.arange(4 * N) / RATE_HZ
    content["y"] += np.exp(-DAMPING * 2 * np.pi * F0_HZ * time_s) * np.cos(1570 * time_s)
    path = tmp_path / "a.npz"
    for harmonics in (None, np.arange(80, 121)):
        np.savez(path, **content, **({} if harmonics is None else {"excited_harmonics": harmonics}))
        assert cli.main(["analyze", str(path), "--band", "200", "300"]) == 0
        notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note")]
        assert not any("delay" in note or "settled" in note for note in notes)
