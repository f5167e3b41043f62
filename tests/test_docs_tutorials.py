# Licensed under a 3-clause BSD style license - see LICENSE
"""The tutorials run, on simulated data and on real tables, and become notebooks."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

TUTORIALS = sorted((Path(__file__).resolve().parents[1] / "docs" / "tutorials").glob("plot_*.py"))
# those that take longer than about five seconds
LONG = ("plot_5_cubes", "plot_6_figures_of_the_paper")


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    """Run in an empty folder, and close the figures."""
    plt = pytest.importorskip("matplotlib.pyplot")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ASTROPOLCAL_DATA", raising=False)
    yield plt
    plt.close("all")


def _slow(path):
    return [pytest.mark.slow] if path.stem in LONG else []


def _run(path):
    return runpy.run_path(str(path))


def _quartz(found, real):
    """The thickness that was simulated, and the published one of the real plate."""
    calibration = found["calibration"]
    quartz, error = calibration.chain["hwp"].w_sio2.value, calibration.covariance.std("hwp.w_sio2")
    put_in = found["truth"]["hwp"].w_sio2.value if "truth" in found and not real else 1.653
    assert abs(quartz - put_in) < 5 * error.to_value("mm")
    assert error.to_value("mm") < 0.01


def _mirrors(found, real):
    """First and last diattenuations that were simulated, and those of the paper."""
    known = found["calibration"].parameter_values()
    m3, fold = (
        np.asarray(known[f"{name}.diattenuation"]["value"], dtype=float)[[0, -1]]
        for name in ("m3", "fold_mirror")
    )
    # the polarization of the star itself is known to 0.18 %
    assert np.all(np.abs(m3 - ((0.0174, 0.0120) if real else (0.017, 0.012))) < (0.004, 0.004))
    assert np.abs(fold - ((0.0122, 0.0079) if real else (0.012, 0.008))).max() < 5e-4


def _causes(found, real):
    """Both secrets of the simulated instrument, and no third."""
    effects = [cause.effect.name for cause in found["diagnosis"].causes]
    if not real:
        assert sorted(effects) == ["beam_gain", "hwp_diattenuation"]


def _ring(found, real):
    """The whole chain gives the polarized light of the ring back, an ideal one less of it."""
    bright, bins = found["bright"], found["bins"]
    shares = {}
    for name in ("plain", "full"):
        degree = np.hypot(found[name]["Q"], found[name]["U"])[bins]
        shares[name] = degree[:, bright].sum(axis=1) / found["truth"][bright].sum()
    assert np.abs(shares["full"] - 1).max() < 0.02
    assert shares["plain"].min() < (0.99 if real else 0.7)


def _star(found, real):
    """Of cubes what was put in; the unpolarized standard within 0.25 % of nothing."""
    _quartz(found, real)
    star = found["fit"].chain["star"]
    for name, expected in zip("qu", (0, 0) if real else (0.008, -0.006), strict=True):
        off = getattr(star, name).value - expected
        errors = [float(found["fit"].covariance.std(f"star.{name}[{i}]")) for i in range(22)]
        if real:
            assert np.abs(off).max() < 0.0025
        else:
            assert np.sqrt(np.mean((off / errors) ** 2)) < 1.6


def _derotators(found, real):
    """The elliptical derotator follows the lamp better; on real tables by as much as measured."""
    medians = {
        name: np.median(found[name].accuracy["s_mean"].to_value("percent"))
        for name in ("linear", "elliptical")
    }
    assert medians["elliptical"] < 0.7 * medians["linear"]
    if real:
        assert medians["elliptical"] == pytest.approx(0.052, abs=0.002)
        assert medians["linear"] == pytest.approx(0.095, abs=0.003)


#: What a tutorial has to find, given whether its data are real.
FINDS = {
    "plot_1_internal_source": _quartz,
    "plot_2_stars": _mirrors,
    "plot_3_diagnosis": _causes,
    "plot_4_disk": _ring,
    "plot_5_cubes": _star,
    "plot_6_figures_of_the_paper": _derotators,
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=_slow(path), id=path.stem) for path in TUTORIALS]
)
def test_tutorial_runs(path, in_folder, tmp_path):
    FINDS[path.stem](_run(path), real=False)
    assert in_folder.get_fignums(), f"{path.name} draws nothing"
    assert not list(tmp_path.iterdir()), f"{path.name} leaves files behind"


# that frames of the warming lamp are masked is said by a warning
@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*frames masked:astropolcal.exceptions.AstropolcalWarning")
@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_tutorial_runs_on_real_tables(path, in_folder, tmp_path, monkeypatch, shared_data):
    monkeypatch.setenv("ASTROPOLCAL_DATA", str(shared_data / "data" / "charis"))
    found = _run(path)
    assert found["folder"], f"{path.name} does not look for ASTROPOLCAL_DATA"
    FINDS[path.stem](found, real=True)
    assert in_folder.get_fignums()
    assert not list(tmp_path.iterdir()), f"{path.name} leaves files behind"


def test_there_are_tutorials():
    assert len(TUTORIALS) >= 6
    assert {path.stem for path in TUTORIALS} == set(FINDS)


@pytest.mark.slow
def test_tutorial_becomes_a_notebook():
    for path in TUTORIALS:
        parser = pytest.importorskip("sphinx_gallery.py_source_parser")
        notebook = pytest.importorskip("sphinx_gallery.notebook")
        from sphinx_gallery.gen_gallery import DEFAULT_GALLERY_CONF

        _, blocks = parser.split_code_and_text_blocks(str(path))
        made = notebook.jupyter_notebook(blocks, dict(DEFAULT_GALLERY_CONF), str(path.parent))
        cells = json.loads(json.dumps(made))["cells"]
        kinds = [cell["cell_type"] for cell in cells]
        assert kinds[0] == "markdown", path
        assert kinds.count("code") >= 3, path
