# Licensed under a 3-clause BSD style license - see LICENSE
"""The base of all optics: mounts, positions, light, and the rotation derivative."""

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import Parameter

from astropolcal import mueller
from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.mueller import rotation_generator
from astropolcal.optics import Diattenuator, LinearPolarizer, LinearRetarder, Optic

WAVELENGTH = [1.2, 1.6, 2.1] * u.um


class TwoParameters(Optic):
    """Not of the package: what a user would write."""

    first = Parameter(default=1.0, bounds=(0, 2), description="an attenuation")
    second = Parameter(default=0.0, unit=u.um, bounds=(0, 2), description="a path")

    def _matrix(self, dispersion, first, second):
        phase = second / np.asarray(dispersion)
        return np.asarray(first)[..., None, None] * mueller.linear_retarder(phase * u.rad)

    def _derivatives(self, dispersion, first, second):
        raise NotImplementedError


def test_an_optic_is_abstract():
    with pytest.raises(TypeError, match="abstract"):
        Optic()


def test_an_optic_of_ones_own():
    optic = TwoParameters(first=0.5, second=800 * u.nm, theta=30 * u.deg)
    assert optic.param_names == ("theta", "first", "second")
    assert optic.second.value == pytest.approx(0.8)
    expected = 0.5 * mueller.rotate(mueller.linear_retarder(0.5 * u.rad), 30 * u.deg)
    np.testing.assert_allclose(optic.mueller(1.6 * u.um), expected, rtol=0, atol=1e-14)


def test_copies_with_other_values_keep_a_keyword_of_ones_own():
    class Stack(TwoParameters):
        """Several plates, a number that is no setting which the package knows."""

        def __init__(self, count, **keywords):
            super().__init__(**keywords)
            self.count = count

        def _matrix(self, dispersion, first, second):
            return super()._matrix(dispersion, first, self.count * second)

    stack = Stack(3, second=[0.1, 0.2, 0.3] * u.um, wavelength=WAVELENGTH, name="stack")
    stack.second.std = [0.01, 0.02, 0.03]
    expected = stack.mueller(WAVELENGTH[1:])
    for copy in (
        stack.with_parameters(first=1.0),
        stack.with_parameters(second=[0.2, 0.3] * u.um),
        stack.resampled(WAVELENGTH[1:]),
    ):
        np.testing.assert_allclose(copy.mueller(WAVELENGTH[1:]), expected, rtol=0, atol=1e-14)
    # what is known of the values stays with them alone
    kept, other = stack.with_parameters(first=0.5), stack.with_parameters(second=0.1 * u.um)
    assert kept.second.std == [0.01, 0.02, 0.03]
    assert kept.second.wavelength[0] == WAVELENGTH[0]
    assert other.second.std is None
    assert other.second.wavelength is None


# --- rotation ----------------------------------------------------------------------


def test_rotation_generator_leaves_its_argument_alone():
    matrix = np.arange(16.0).reshape(4, 4)
    rotation_generator(matrix)
    np.testing.assert_array_equal(matrix, np.arange(16.0).reshape(4, 4))


# --- where the optic stands ----------------------------------------------------------


def test_mount_names_a_stage_and_a_sign():
    for mount, stage, sign in [(None, None, 1), ("hwp", "hwp", 1), ("-altitude", "altitude", -1)]:
        optic = LinearRetarder(mount=mount)
        assert (optic.mount, optic.stage, optic.stage_sign) == (mount, stage, sign), (
            mount,
            stage,
            sign,
        )
    for mount in ["", "-", "--hwp", " ", 3, ["hwp"]]:
        with pytest.raises(ParameterError, match=r"mount = .* must be None or the name of a stage"):
            LinearRetarder(mount=mount)


def test_position_has_a_unit():
    optic = LinearRetarder(mount="hwp")
    optic.position = 90 * u.deg
    assert optic.position.to_value(u.rad) == pytest.approx(np.pi / 2)
    with pytest.raises(ParameterError, match="position = 90 needs a unit"):
        optic.position = 90
    with pytest.raises(ParameterError, match=r"position = .* must be finite"):
        optic.position = [0, np.nan] * u.deg
    with pytest.raises(ParameterError, match="position = nan deg must be finite"):
        optic.mueller(position=np.nan * u.deg)


def test_positions_broadcast_against_wavelengths():
    optic = LinearRetarder(retardance=[100, 120, 140] * u.deg, mount="hwp")
    angles = [0, 10, 20, 30] * u.deg
    grid = optic.mueller(WAVELENGTH, angles[:, None])
    assert grid.shape == (4, 3, 4, 4)
    for i, angle in enumerate(angles):
        for j, retardance in enumerate(optic.retardance.value):
            expected = mueller.rotate(mueller.linear_retarder(retardance * u.deg), angle)
            np.testing.assert_allclose(grid[i, j], expected, rtol=0, atol=1e-14)
    plate = LinearRetarder(mount="hwp")
    for wrong in ((4,), (2, 4)):
        with pytest.raises(ParameterError, match=r"give the positions the shape \(n_frames, 1\)"):
            plate.mueller(WAVELENGTH, np.ones(wrong) * u.rad)
    assert plate.mueller(np.ones((3, 1, 5)) * u.um, np.ones((2, 5)) * u.rad).shape == (2, 5, 4, 4)


# --- light ---------------------------------------------------------------------------


def test_scalar_light_stays_scalar():
    through = LinearPolarizer()(1.6 * u.um, 1, 0, 0, 0)
    assert [np.shape(x) for x in through] == [()] * 5
    assert through[0] == 1.6 * u.um


def test_light_at_many_positions_needs_its_shape():
    optic = LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    optic.position = [0, 22.5, 45] * u.deg
    with pytest.raises(ParameterError, match=r"hwp stands at 3 positions: give light of shape"):
        optic(1.6 * u.um, 1, 1, 0, 0)
    ones = np.ones(3)
    _, _, q, u_, _ = optic(1.6 * u.um, ones, ones, 0 * ones, 0 * ones)
    np.testing.assert_allclose(q, [1, 0, -1], atol=1e-14)
    np.testing.assert_allclose(u_, [0, 1, 0], atol=1e-14)


def test_wavelength_is_positive_and_has_a_unit_of_length():
    for wavelength in [0 * u.um, -1 * u.um, np.nan * u.um, [1, 0] * u.um]:
        with pytest.raises(ParameterError, match="must be positive"):
            LinearRetarder().mueller(wavelength)
    with pytest.raises(ParameterError, match="needs a unit such as um"):
        LinearRetarder()(1.6, 1, 0, 0, 0)
    with pytest.raises(ParameterError, match="wavelength has unit s"):
        LinearRetarder().mueller(1.6 * u.s)


# --- what astropy offers -------------------------------------------------------------


def test_values_that_are_refused():
    with pytest.raises(ParameterError, match="complex"):
        LinearRetarder(retardance=1j * u.deg)
    with pytest.raises(ParameterError, match="complex"):
        Diattenuator(diattenuation=0.1j)
    with pytest.raises(ParameterError, match="LinearRetarder"):
        LinearRetarder(retardance=[1, 2] * u.deg, theta=[1, 2, 3] * u.deg)
    with pytest.raises(ParameterError, match="LinearRetarder"):
        LinearRetarder(retardance=[1, 2] * u.deg, n_models=2)


def test_constraints_can_be_given_when_the_optic_is_made():
    optic = LinearRetarder(
        retardance=90 * u.deg, bounds={"retardance": (80, 100)}, fixed={"theta": False}
    )
    assert optic.retardance.bounds == (80, 100)
    assert not optic.theta.fixed
    # and the class is not touched
    assert LinearRetarder().retardance.bounds == (-360, 360)
    assert LinearRetarder().theta.fixed
    with pytest.raises(ParameterError, match="bounds of retardance"):
        optic.retardance.bounds = (np.nan, 100)


def test_values_are_canonical_floats():
    optic = LinearRetarder(retardance=[90, 180] * u.deg, theta=45 * u.deg)
    theta, retardance = optic.canonical_values()
    assert theta == pytest.approx(np.pi / 4)
    np.testing.assert_allclose(retardance, [np.pi / 2, np.pi], rtol=1e-15)
    # percent is a number
    assert Diattenuator(diattenuation=5 * u.percent).diattenuation.value == pytest.approx(0.05)
    # parameter of another optic is a value
    one = LinearRetarder(retardance=1 * u.rad)
    other = LinearRetarder(retardance=one.retardance)
    assert other.retardance.value == pytest.approx(np.degrees(1))
    assert other.retardance is not one.retardance


# --- wavelengths of the values ---------------------------------------------------------


def test_values_per_wavelength_are_interpolated_where_they_are_known():
    optic = LinearRetarder(retardance=[100, 120, 140] * u.deg, wavelength=WAVELENGTH, name="hwp")
    assert optic.retardance.wavelength.to_value(u.nm) == pytest.approx([1200, 1600, 2100])
    assert optic.theta.wavelength is None
    for copy in (optic, optic.copy(), optic.with_parameters(theta=0 * u.deg)):
        for wavelength, retardance in (
            (1.4 * u.um, 110),
            ([1.4, 1.85] * u.um, [110, 130]),
            (WAVELENGTH, [100, 120, 140]),
        ):
            expected = mueller.linear_retarder(retardance * u.deg)
            np.testing.assert_allclose(copy.mueller(wavelength), expected, atol=1e-12)
    assert optic(1.4 * u.um, 1, 0, 1, 0)[3] == pytest.approx(np.cos(np.deg2rad(110)))
    assert u.isclose(optic.curve("retardance")(1.4 * u.um), 110 * u.deg)
    assert optic.curve("mueller", (2, 2))(1.4 * u.um) == pytest.approx(np.cos(np.deg2rad(110)))
    with pytest.raises(WavelengthRangeError, match=r"retardance is known from 1\.2 to 2\.1 um"):
        optic.mueller(2.2 * u.um)
    for wrong in ([1.2, 1.6] * u.um, [1.2, 2.1, 1.6] * u.um, [0, 1, 2] * u.um):
        with pytest.raises(ParameterError, match="wavelengths of retardance"):
            optic.retardance.wavelength = wrong
    with pytest.raises(ParameterError, match="3 values, one per wavelength, but 2"):
        LinearRetarder(retardance=[100, 120, 140] * u.deg).mueller([1.4, 1.85] * u.um)


def test_values_come_as_spectra_and_are_resampled():
    specutils = pytest.importorskip("specutils", reason="specutils is not installed")
    from astropy.nddata import VarianceUncertainty
    from specutils.manipulation import LinearInterpolatedResampler

    # by frequency, so that wavelengths fall
    spectrum = specutils.Spectrum(
        flux=np.deg2rad([140, 120, 100]) * u.rad,
        spectral_axis=WAVELENGTH[::-1].to(u.THz, u.spectral()),
        uncertainty=VarianceUncertainty(np.deg2rad([3, 2, 1]) ** 2 * u.rad**2),
    )
    optic = LinearRetarder(retardance=spectrum, name="film")
    np.testing.assert_allclose(optic.retardance.value, [100, 120, 140])
    np.testing.assert_allclose(optic.retardance.std, [1, 2, 3])
    np.testing.assert_allclose(optic.retardance.wavelength.value, WAVELENGTH.value)
    grid = [1.3, 1.6, 1.9] * u.um
    new = optic.resampled(grid)
    by_wavelength = specutils.Spectrum(
        flux=optic.retardance.quantity, spectral_axis=optic.retardance.wavelength
    )
    expected = LinearInterpolatedResampler()(by_wavelength, grid)
    np.testing.assert_allclose(new.retardance.quantity, expected.flux)
    np.testing.assert_allclose(new.retardance.wavelength, grid)
    np.testing.assert_allclose(new.retardance.std, [1.25, 2, 2.6])
    assert new.with_parameters(retardance=spectrum).retardance.wavelength[0] == 1.2 * u.um
    with pytest.raises(WavelengthRangeError, match=r"not at 1\.1 um"):
        optic.resampled([1.1, 1.2] * u.um)
    with pytest.raises(ParameterError, match="its wavelengths are not known"):
        LinearRetarder(retardance=[1, 2] * u.deg).resampled(grid)
    with pytest.raises(ParameterError, match="masked"):
        LinearRetarder(
            retardance=specutils.Spectrum(
                flux=spectrum.flux, spectral_axis=WAVELENGTH, mask=np.array([True, False, False])
            )
        )
