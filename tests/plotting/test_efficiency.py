# Licensed under a 3-clause BSD style license - see LICENSE
"""The polarimetric efficiency, and standard stars over a night."""

import astropy.units as u
import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal import instruments, optics
from astropolcal.chain import remove_optic
from astropolcal.efficiency import polarimetric_efficiency
from astropolcal.instruments import SkyLaw
from astropolcal.plotting import efficiency
from astropolcal.plotting.efficiency import plot_polarimetric_efficiency

CHARIS = instruments.get("charis")


@pytest.fixture(scope="module")
def figure():
    return plot_polarimetric_efficiency(
        CHARIS.on_sky(CHARIS.published()),
        CHARIS.wavelength,
        altitude=60 * u.deg,
        parallactic=94 * u.deg,
        shown=[1.2, 1.58, 2.3] * u.um,
        title="CHARIS",
    )


def test_lines_are_the_wavelengths_asked_for(figure):
    lines = figure.axes[0].get_lines()
    assert [line.get_label() for line in lines] == ["1200 nm", "1575 nm", "2290 nm"]
    derotator = lines[1].get_xdata()
    expected = polarimetric_efficiency(
        CHARIS.on_sky(CHARIS.published()),
        CHARIS.wavelength,
        derotator=derotator * u.deg,
        altitude=60 * u.deg,
        parallactic=94 * u.deg,
    )
    np.testing.assert_allclose(lines[1].get_ydata(), expected[:, 9])
    assert lines[1].get_ydata().min() < 0.4
    # axes are labelled with units
    labels = [(ax.get_xlabel(), ax.get_ylabel()) for ax in figure.axes[:3]]
    assert labels == [
        ("derotator angle (deg)", "measured share of the polarization"),
        ("derotator angle (deg)", "wavelength (nm)"),
        ("parallactic angle (deg)", "altitude (deg)"),
    ]
    assert figure.get_suptitle() == "CHARIS"
    assert "altitude 60°, parallactic angle 94°" in figure.axes[0].get_title()


def test_internal_chain_has_no_map_of_pointings():
    figure = plot_polarimetric_efficiency(CHARIS.published(), CHARIS.wavelength, figure=Figure())
    # two panels and a colour bar
    assert len(figure.axes) == 3
    assert figure.axes[0].get_title() == "downstream of the internal source"


def test_few_filters_are_rows_of_their_own():
    irdis = instruments.get("irdis")
    figure = plot_polarimetric_efficiency(irdis.published(), irdis.wavelength, instrument=irdis)
    labels = [text.get_text() for text in figure.axes[1].get_yticklabels()]
    assert labels == ["1043", "1245", "1625", "2182"]
    # one alone is seen, too
    chain = irdis.chain("polarized", wavelength=irdis.wavelength[1:2])
    axes = plot_polarimetric_efficiency(chain, irdis.wavelength[1:2], instrument=irdis).axes[1]
    assert np.ptp(axes.collections[0].get_coordinates()[..., 1]) == 1


def test_without_a_derotator_the_sky_turns():
    chain = (
        optics.Rotator(mount="parallactic", name="sky")
        | optics.LinearRetarder(retardance=[60, 90] * u.deg, name="relay")
        | optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(name="wollaston")
    )

    class Fixed:
        sky_law = SkyLaw(plate=(0, 0), derotator={})

    (ax,) = plot_polarimetric_efficiency(chain, [1.2, 1.6] * u.um, instrument=Fixed()).axes
    assert ax.get_xlabel() == "parallactic angle (deg)"
    assert len(ax.get_lines()) == 2
    assert ax.get_lines()[1].get_ydata().min() < 0.05
    inside = remove_optic(chain, "sky")
    (ax,) = plot_polarimetric_efficiency(inside, [1.2, 1.6] * u.um).axes
    assert ax.get_xlabel() == "wavelength (nm)"


def test_lines_of_the_efficiency():
    for shown, names in [
        (None, ["1200 nm", "1400 nm", "1600 nm", "1800 nm", "2000 nm", "2200 nm"]),
        # the nearest, each once
        ([1190, 1210, 2300] * u.nm, ["1200 nm", "2200 nm"]),
    ]:
        lam = np.arange(1200.0, 2201, 200)
        axes = Figure().subplots()
        values = np.linspace(0, 1, 5)[:, None] * np.ones(lam.size)
        efficiency._lines(axes, lam, np.arange(5), values, shown)
        assert [line.get_label() for line in axes.lines] == names, (shown, names)
        np.testing.assert_allclose(axes.lines[0].get_ydata(), values[:, 0])
        assert axes.get_ylabel() == "measured share of the polarization", (shown, names)
