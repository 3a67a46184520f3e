# SPDX-License-Identifier: Apache-2.0
"""The package as a library: `import tactile_resonance as tr`."""

import doctest
import subprocess
import sys

import numpy as np
import pytest

import tactile_resonance as tr
from tactile_resonance import front
from tactile_resonance.recording.store import RecordStore
from test.recording import stores


def test_examples_run():
    for module in (tr, front):
        result = doctest.testmod(module, extraglobs={"tr": tr})
        assert result.attempted > 0
        assert result.failed == 0


def test_every_public_name_is_there():
    for name in tr.__all__:
        value = getattr(tr, name)
        assert value.__name__ == name
        assert value.__doc__
    assert set(tr.__all__) < set(dir(tr))
    with pytest.raises(AttributeError, match="no attribute 'estimate_frv'"):
        tr.estimate_frv  # noqa: B018


def test_nothing_is_loaded_before_it_is_used():
    code = "import sys, tactile_resonance; print('numpy' in sys.modules, 'scipy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_a_file_goes_to_its_poles(tmp_path):
    """A resonance from rest: no period is settled, the transient is estimated along."""
    rate_hz, samples, f0_hz, damping = 5e3, 2000, 250.0, 0.02
    multisine = tr.design_multisine(
        sample_rate_hz=rate_hz, samples_per_period=samples, band_hz=(150.0, 350.0), seed=3
    )
    u = np.tile(multisine.period(), 4)
    # the same response to zeros before it: circular over twice the record
    s, w0 = 2j * np.pi * np.fft.rfftfreq(2 * u.size, 1 / rate_hz), 2 * np.pi * f0_hz
    g = 0.04 * w0**2 / (s**2 + 2 * damping * w0 * s + w0**2)
    y = np.fft.irfft(g * np.fft.rfft(np.concatenate([u, 0 * u])))[: u.size]
    y += 1e-3 * np.random.default_rng(2).standard_normal(y.size)
    path = tmp_path / "record.npz"
    fields = {"sample_rate_hz": rate_hz, "samples_per_period": samples}
    np.savez(path, u=u, y=y, excited_harmonics=multisine.harmonics, **fields)
    recording = tr.read_record(path)
    poles = tr.identify_poles(recording, band_hz=(200, 300))
    assert poles.status is tr.PolesStatus.OK
    assert np.all(np.abs(poles.main.estimate - [f0_hz, damping]) < 4 * poles.main.std)
    of_frf = tr.identify_poles(tr.estimate_frf(recording), band_hz=(200, 300))
    assert np.all(np.abs(of_frf.main.estimate - [f0_hz, damping]) < 5 * of_frf.main.std)
    assert of_frf.main.std[0] > poles.main.std[0]


def test_a_folder_of_stored_records_is_read_as_it_was_measured(tmp_path):
    """Samples and lines come back; one of several measurements is named, and so many periods are used."""
    store = RecordStore(tmp_path)
    planned, records = stores.write(store, 7, realisations=2, periods=4)
    recording = tr.read_record(tmp_path)
    assert recording.sample_rate_hz == planned[0].sample_rate_hz
    np.testing.assert_array_equal(recording.excited_harmonics, planned[0].harmonics)
    for channel, found in (("actuator", recording.u), ("sensor", recording.y)):
        volts = np.reshape([getattr(record, channel).volts() for record in records], found.shape)
        np.testing.assert_array_equal(found, volts)
    assert recording.u.shape == (2, 4, stores.SAMPLES)
    assert tr.read_record(tmp_path, periods=3).u.shape == (2, 3, stores.SAMPLES)
    _, others = stores.write(store, 9)
    with pytest.raises(ValueError, match="measurement_id: not given, .* holds 7, 9"):
        tr.read_record(tmp_path)
    chosen = tr.read_record(tmp_path, 9)
    np.testing.assert_array_equal(chosen.y[0, 0], others[0].sensor.volts())


def test_something_else_than_a_recording_is_refused():
    for call in (tr.estimate_frf, tr.identify_poles):
        with pytest.raises(ValueError, match="data: got a str; accepted is a Recording"):
            call("record.npz")


def test_run_without_rosbags_is_refused_with_what_to_install(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("tactile_resonance.scan")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(sys.modules["tactile_resonance"], "scan", raising=False)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    for name in [name for name in sys.modules if name.startswith("rosbags.")]:
        monkeypatch.delitem(sys.modules, name)
    (tmp_path / "run.json").write_text("{}")
    for call in (tr.read_run, tr.read_record):
        with pytest.raises(ValueError, match="pip install 'rosbags"):
            call(tmp_path)


def test_fields_of_a_file_are_refused_for_a_folder(tmp_path):
    with pytest.raises(ValueError, match="sample_rate_hz: not for a folder"):
        tr.read_record(tmp_path, sample_rate_hz=1e3)
    (tmp_path / "x.npz").touch()
    with pytest.raises(ValueError, match="measurement: 3, only for a folder"):
        tr.read_record(tmp_path / "x.npz", 3)
    with pytest.raises(FileNotFoundError, match="nothing_here"):
        tr.read_record(tmp_path / "nothing_here")
