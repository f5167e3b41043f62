# Licensed under a 3-clause BSD style license - see LICENSE
"""The instrument as it would be if it only turned, mirrored and split."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join, leaves, system_mueller
from astropolcal.correction import ideal_chain

LAM = [1.2, 1.6, 2.2] * u.um
SPLITTER = optics.WollastonPrism(efficiency=0.9, name="wollaston")


def of(*found):
    """Return the ideal chain of some optics before a splitter."""
    return ideal_chain(join([*found, SPLITTER]), LAM)


def without_splitter(chain):
    """Return the Mueller matrix of what stands before the splitter."""
    before = leaves(chain)[:-1]
    if not before:
        return np.eye(4)
    return np.squeeze(system_mueller(join(before), LAM[:1], {}))


def test_a_splitter_is_perfect_and_stays_where_it_is():
    tilted = optics.WollastonPrism(efficiency=0.9, theta=7 * u.deg, name="w", mount="table")
    ideal = leaves(ideal_chain(tilted, LAM))[0]
    assert (ideal.name, ideal.mount) == ("w", "table")
    assert ideal.efficiency.value == 1
    assert ideal.theta.quantity == 7 * u.deg


def test_what_turns_is_a_half_wave_plate():
    plate = optics.LinearRetarder(retardance=150 * u.deg, theta=3 * u.deg, mount="hwp", name="hwp")
    ideal = of(plate)["hwp"]
    assert ideal.retardance.quantity == 180 * u.deg
    assert ideal.theta.quantity == 3 * u.deg
    assert ideal.mount == "hwp"


def test_what_turns_the_axes_stays_as_it_is():
    rotator = optics.Rotator(theta=12 * u.deg, mount="parallactic", name="parallactic")
    assert leaves(of(rotator))[0] is rotator


def test_what_stands_still_is_what_it_comes_closest_to():
    for retardance, expected in [
        (0, np.eye(4)),
        (20, np.eye(4)),
        (-30, np.eye(4)),
        (340, np.eye(4)),
        (150, np.diag([1.0, 1, -1, -1])),
        (-170, np.diag([1.0, 1, -1, -1])),
    ]:
        fixed = optics.LinearRetarder(retardance=retardance * u.deg, name="fixed")
        np.testing.assert_allclose(without_splitter(of(fixed)), expected, atol=1e-12)


def test_losses_do_not_count():
    """A beamsplitter that takes 10 percent of one polarization does nothing in an ideal world."""
    fixed = optics.DiattenuatorRetarder(diattenuation=0.1, retardance=30 * u.deg, name="nbs")
    assert [leaf.name for leaf in leaves(of(fixed))] == ["wollaston"]
    mirror = optics.DiattenuatorRetarder(diattenuation=0.1, retardance=170 * u.deg, name="m3")
    expected = np.diag([1.0, 1, -1, -1])
    np.testing.assert_allclose(without_splitter(of(mirror)), expected, atol=1e-12)


def test_a_mirror_image_is_a_flip():
    """Of Q and V, which a plate of half a wave at 45 deg makes."""
    plate = optics.LinearRetarder(retardance=180 * u.deg, theta=45 * u.deg, name="k")
    elliptical = optics.EllipticalRetarder(
        horizontal=0 * u.deg, diagonal=175 * u.deg, circular=5 * u.deg, name="k"
    )
    flip = np.diag([1.0, -1, 1, -1])
    for fixed in (plate, elliptical):
        np.testing.assert_allclose(without_splitter(of(fixed)), flip, atol=1e-12)


def test_an_angle_of_what_stands_still_is_kept():
    mirror = optics.LinearRetarder(retardance=175 * u.deg, theta=10 * u.deg, name="m")
    perfect = optics.LinearRetarder(retardance=180 * u.deg, theta=10 * u.deg, name="m")
    expected = np.squeeze(system_mueller(perfect, LAM[:1], {}))
    np.testing.assert_allclose(without_splitter(of(mirror)), expected, atol=1e-12)


def test_a_retardance_that_changes_with_wavelength_is_averaged():
    """At 160, 180 and 200 deg it is a half-wave plate, as it is at their mean."""
    fixed = optics.LinearRetarder(retardance=[160, 180, 200] * u.deg, name="m")
    expected = np.diag([1.0, 1, -1, -1])
    np.testing.assert_allclose(without_splitter(of(fixed)), expected, atol=1e-12)


def test_faults_of_the_instrument_are_left_out():
    gain = optics.BeamGain(imbalance=0.1, name="gain")
    drift = optics.DriftRotator(rate=3 * u.deg, mount="sequence", name="drift")
    chain = join([drift, SPLITTER, gain])
    assert [leaf.name for leaf in leaves(ideal_chain(chain, LAM))] == ["wollaston"]


def test_no_instrument_polarizes(sky, charis, track):
    """Of unpolarized light both ideal beams see half, in every frame."""
    from astropolcal.correction import measurement_rows

    _, positions = track(1)
    ideal = ideal_chain(sky, charis.wavelength)
    rows = measurement_rows(ideal, positions, charis.wavelength, chain=ideal)
    np.testing.assert_allclose(rows[..., 0], 0.5, atol=1e-12)
    # and all of linear polarization is measured: the two beams differ by a unit vector
    np.testing.assert_allclose(np.linalg.norm(rows[0] - rows[1], axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(rows[..., 3], 0, atol=1e-12)
