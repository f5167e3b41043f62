# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of mirrors: values, bands, metals, and what is held."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest

from astropolcal import optics
from astropolcal.calibration.uncertainty.derived import mirror_values
from astropolcal.exceptions import ChainError
from astropolcal.plotting import plot_mirrors

SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
NM = np.array([1200.0, 1400.0, 1600.0, 1900.0, 2200.0])


@pytest.fixture(scope="module")
def diattenuator(with_mirror):
    return with_mirror(optics.Diattenuator(diattenuation=np.full(5, 0.012), name="fold"))


@pytest.fixture(scope="module")
def retarder(with_mirror):
    mirror = optics.DiattenuatorRetarder(
        diattenuation=np.full(5, 0.012), retardance=np.full(5, 170.0) * u.deg, name="fold"
    )
    mirror.retardance.fixed = True
    return with_mirror(mirror)


def lines(axes):
    return {line.get_label(): line for line in axes.lines}


def test_values_have_their_errors(diattenuator):
    (axes,) = plot_mirrors(diattenuator).axes
    table = mirror_values(diattenuator, "fold")
    (drawn,) = axes.containers
    line, _, (bars,) = drawn.lines
    assert drawn.get_label() == f"fitted, with 1{SIGMA} error"
    np.testing.assert_allclose(line.get_xdata(), NM)
    np.testing.assert_allclose(line.get_ydata(), table["diattenuation"].to_value(u.percent))
    lengths = [np.ptp(segment[:, 1]) / 2 for segment in bars.get_segments()]
    np.testing.assert_allclose(lengths, table["diattenuation_err"].to_value(u.percent))
    # near the truth of 1.2 percent
    assert np.all(np.abs(line.get_ydata() - 1.2) < 5 * np.array(lengths))


def test_metals_are_drawn_beside_with_looks_of_their_own(diattenuator):
    figure = plot_mirrors(diattenuator)
    (axes,) = figure.axes
    table = mirror_values(diattenuator, "fold")
    found = {key.split(" ")[0]: line for key, line in lines(axes).items() if "bare" in key}
    assert set(found) == {"silver", "gold", "aluminium"}
    for metal, line in found.items():
        np.testing.assert_allclose(
            line.get_ydata(), table[f"diattenuation_{metal}"].to_value(u.percent)
        )
    assert len({line.get_linestyle() for line in found.values()}) == 3
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    # what was calibrated comes before what it is compared with
    assert [("bare" in label) for label in labels] == [False, True, True, True]


def test_labels_of_a_mirror(diattenuator, retarder):
    (axes,) = plot_mirrors(diattenuator).axes
    assert (axes.get_title(), axes.get_ylabel()) == ("fold", "diattenuation (%)")
    assert axes.get_xlabel() == "wavelength (nm)"
    top, bottom = plot_mirrors(retarder).axes
    assert (top.get_ylabel(), bottom.get_ylabel()) == ("diattenuation (%)", "retardance (°)")
    assert (top.get_xlabel(), bottom.get_xlabel()) == ("", "wavelength (nm)")
    assert plot_mirrors(retarder).get_suptitle().startswith("Mirrors\n")


def test_what_is_held_is_hollow_and_has_no_error(retarder):
    _, bottom = plot_mirrors(retarder).axes
    held = lines(bottom)["held, not fitted"]
    assert held.get_markerfacecolor() == "white"
    np.testing.assert_allclose(held.get_ydata(), 170)
    assert not bottom.containers


def test_what_is_published_is_drawn_beside(retarder):
    other = SimpleNamespace(
        diattenuation=lambda lam: 0.01 * lam.to_value(u.um),
        retardance=lambda lam: (180 - 10 * lam.to_value(u.um)) * u.deg,
    )
    top, bottom = plot_mirrors(retarder, reference={"fold": {"law A": other}}).axes
    np.testing.assert_allclose(lines(top)["law A"].get_ydata(), NM / 1000)
    np.testing.assert_allclose(lines(bottom)["law A"].get_ydata(), 180 - NM / 100)
    # of another mirror
    assert "law A" not in lines(plot_mirrors(retarder, reference={"m3": {"law A": other}}).axes[0])


def test_a_law_is_a_line_with_its_band(with_mirror):
    mirror = optics.MetalMirror(material="silver", incidence=45 * u.deg, name="fold")
    for key in mirror.param_names:
        getattr(mirror, key).fixed = key != mirror.param_names[0]
    calibration = with_mirror(mirror)
    top = plot_mirrors(calibration).axes[0]
    label = next(key for key in lines(top) if key.startswith("fitted law"))
    table = mirror_values(calibration, "fold")
    expected = table["diattenuation"].to_value(u.percent)
    np.testing.assert_allclose(lines(top)[label].get_ydata(), expected)
    (band,) = top.collections
    std = table["diattenuation_err"].to_value(u.percent)
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx((expected + std).max())


def test_no_mirror_and_no_such_mirror(elliptical, diattenuator):
    with pytest.raises(ChainError, match="has no mirror to draw"):
        plot_mirrors(elliptical)
    with pytest.raises(ChainError, match="no mirror 'm3'; the calibration has fold"):
        plot_mirrors(diattenuator, ["m3"])
