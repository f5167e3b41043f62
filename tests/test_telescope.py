# Licensed under a 3-clause BSD style license - see LICENSE
"""The chain of a star: source, telescope, tertiary mirror, and what the tables say of it."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from star_data import CHARIS, WAVELENGTH, observe_star, star_chain

from astropolcal import instruments, mueller, standards
from astropolcal.chain import leaves, stages, system_mueller
from astropolcal.exceptions import AstropolcalWarning, InstrumentError, ObservationError
from astropolcal.instruments.telescope import (
    M3_MODELS,
    published_mirror,
    star_source,
    telescope,
    tertiary_mirror,
)
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.observations import Observations
from astropolcal.optics import PolarizedSource


def names(chain):
    return [leaf.name for leaf in leaves(chain)]


# --- chain ----------------------------------------------------------------------------------------


def test_light_goes_from_the_star_to_the_wollaston():
    chain = star_chain()
    assert names(chain) == ["star", "parallactic", "m3", "altitude", "hwp", "derotator",
                            "dichroic", "nbs", "wollaston"]  # fmt: skip
    assert stages(chain) == ["parallactic", "altitude", "hwp", "derotator"] or set(
        stages(chain)
    ) == {"parallactic", "altitude", "hwp", "derotator"}


def test_telescope_is_the_equation_of_the_paper():
    """T(-a) M_M3 T(p), multiplied out with the functions of `mueller`."""
    from astropolcal.chain import join

    a, p, eps = 62 * u.deg, -25 * u.deg, 0.013
    mirror = tertiary_mirror("free", WAVELENGTH[:1])
    mirror.diattenuation, mirror.retardance = [eps], [175] * u.deg
    found = system_mueller(
        join(telescope(mirror)), WAVELENGTH[:1], {"altitude": a, "parallactic": p}
    )
    expected = (
        mueller.rotation_matrix(-a)
        @ mueller.diattenuator_retarder(eps, 175 * u.deg)
        @ mueller.rotation_matrix(p)
    )
    np.testing.assert_allclose(np.squeeze(found), expected, atol=1e-14)


def test_models_of_the_tertiary_mirror():
    """Free are the numbers of the model and, within the tolerance of its mounting, the angle."""
    expected = {
        "free": {"diattenuation"},
        "power law": {"b1", "m1", "b2", "m2"},
        "metal": {"film_thickness", "n_scale", "k_scale"},
    }
    assert set(expected) == set(M3_MODELS)
    for model, numbers in expected.items():
        mirror = tertiary_mirror(model, WAVELENGTH)
        free = {key for key in mirror.param_names if not getattr(mirror, key).fixed}
        assert free == numbers | {"theta"}, model
        assert mirror.name == "m3"
        assert mirror.theta.prior.mean() == 0
        assert 0 < mirror.theta.prior.std() < 1
        assert FreeParameters([star_chain(m3=model)], len(WAVELENGTH)).size > 0


def test_bounds_of_the_power_law_are_the_papers():
    mirror = tertiary_mirror("power law", WAVELENGTH)
    assert mirror.b1.value == 13.70
    assert mirror.b1.bounds == pytest.approx((6.85, 27.4))


def test_published_mirror_falls_from_1_7_to_1_2_percent():
    diattenuation = published_mirror().diattenuation(CHARIS.wavelength)
    assert diattenuation[0] == pytest.approx(0.0174, abs=1e-4)
    assert diattenuation[-1] == pytest.approx(0.0120, abs=1e-4)


def test_internal_chain_is_taken_to_the_sky():
    sky = CHARIS.on_sky(CHARIS.published())
    assert names(sky) == ["parallactic", "m3", "altitude", "hwp", "derotator", "dichroic", "nbs",
                          "wollaston"]  # fmt: skip
    assert CHARIS.on_sky(sky) is sky


def test_instrument_without_a_telescope_says_so():
    class Bench(instruments.Instrument):
        name = "bench"

        def chain(self, source="polarized", optics_in=(), *, wavelength=None):
            return PolarizedSource(name="lamp")

        def setup(self, observations):
            return "polarized", ()

    with pytest.raises(InstrumentError, match="bench: no chain from the sky"):
        Bench().on_sky(CHARIS.published())


def test_option_that_a_chain_does_not_have_is_an_error():
    table = observe_star(star_chain(), 2, noise=False)
    with pytest.raises(InstrumentError, match="charis: its chain has no option colour"):
        CHARIS.chains_for([table], colour="red")


# --- sources --------------------------------------------------------------------------------------


def drawn(star, n=800):
    """Return q + iu of a star for values drawn from its priors, (n, n_wavelengths)."""
    rng, sizes = np.random.default_rng(0), {}
    for key in star.param_names:
        if getattr(star, key).prior is not None:
            sizes[key] = getattr(star, key).prior.rvs(n, random_state=rng)
    units = {key: getattr(star, key).unit or u.one for key in sizes}
    light = []
    for i in range(n):
        one = star.with_parameters(**{key: v[i] * units[key] for key, v in sizes.items()})
        light.append(np.array([1, 1j]) @ one.stokes(WAVELENGTH))
    return np.array(light)


@pytest.mark.slow
def test_an_unpolarized_standard_is_zero_with_the_error_of_the_catalogue():
    """q and u have the catalogue's error at each wavelength, and hang together between them."""
    for target, error in (("HD 293396", 0.0018), (None, 0.001)):
        star = star_source("unpolarized standard star", WAVELENGTH, target=target)
        np.testing.assert_allclose(star.stokes(WAVELENGTH), 0)
        light = drawn(star)
        for part in (light.real, light.imag):
            np.testing.assert_allclose(part.std(axis=0), error, rtol=0.15)
            assert np.corrcoef(part.T).min() > 0.7


def test_a_polarized_standard_is_that_of_the_catalogue_with_its_errors():
    star = star_source("polarized standard star", WAVELENGTH, target="HD 30675")
    mean = np.array([1, 1j]) @ star.stokes(WAVELENGTH)
    # Whittet et al. 1992: J 1.90 %, H 1.10 %, 58 to 61 deg
    np.testing.assert_allclose(np.abs(mean[:2]), [0.019, 0.011], atol=0.002)
    np.testing.assert_allclose(np.rad2deg(np.angle(mean)) / 2, 59, atol=3)


@pytest.mark.slow
def test_the_angle_of_a_polarized_standard_is_no_better_known_than_in_the_catalogue():
    """Far from the wavelengths at which it was measured, too, and whatever law it follows there."""
    for target in ("HD 30675", "HD 147084", "SLS 3386"):
        q, stokes_u, covariance = (np.asarray(x) for x in standards.get(target).stokes(WAVELENGTH))
        star = star_source("polarized standard star", WAVELENGTH, target=target)
        turned = np.rad2deg(np.angle(drawn(star) / (q + 1j * stokes_u))) / 2
        degree = np.hypot(q, stokes_u)
        across = np.stack([-stokes_u, q], -1) / degree[:, None]
        error = np.sqrt(np.einsum("wi,wij,wj->w", across, covariance, across)) / degree
        # half of all within 0.67 standard deviations; few draws have hardly any polarization left
        offset = np.median(turned, axis=0)
        spread = np.median(np.abs(turned - offset), axis=0) / 0.6745
        assert np.all(spread > 0.93 * np.rad2deg(error) / 2), target
        assert np.all(np.abs(offset) < 1.07 * spread), target
        assert np.all(spread < 4 * np.rad2deg(error) / 2), target


def test_a_polarized_standard_may_be_observed_at_its_maximum_alone():
    longest = standards.get("HD 7927").interstellar().law.lambda_max.quantity
    star = star_source("polarized standard star", u.Quantity([longest]), target="HD 7927")
    assert star.rotation.prior.std() > 0


def test_star_that_no_catalogue_knows_is_free():
    for target in [None, "no such star"]:
        star = star_source("star", WAVELENGTH, target=target)
        assert star.q.prior is None, target
        assert not star.q.fixed, target
        assert star.q.value.shape == (3,), target


def test_every_star_has_its_own_source():
    tables = [
        observe_star(star_chain(), 2, target=t, noise=False) for t in ("HD 14069", "HD-293396")
    ]
    chains = CHARIS.chains_for(tables)
    assert [names(chain)[0] for chain in chains] == ["star_HD14069", "star_HD293396"]
    assert [names(chain)[2] for chain in chains] == ["m3", "m3"]


def test_table_of_a_star_leads_to_its_chain():
    for source in ["unpolarized standard star", "polarized standard star", "star"]:
        table = observe_star(star_chain(), 2, source=source, noise=False)
        assert CHARIS.setup(table) == (source, ("dichroic", "nbs")), source


# --- prepare --------------------------------------------------------------------------------------


def test_star_is_prepared_by_its_cycles():
    star = observe_star(star_chain(), 4, noise=False).select(np.arange(15))
    with pytest.warns(AstropolcalWarning, match="incomplete half-wave-plate cycle"):
        assert CHARIS.prepare(star).mask.all(axis=1).sum() == 3


def test_star_may_fade_behind_clouds():
    lamp = np.ones(16)
    lamp[4:8] = 0.3
    star = observe_star(star_chain(), 4, lamp=lamp, noise=False)
    assert not CHARIS.prepare(star).mask.any()


def test_star_without_pointing_is_refused():
    table = observe_star(star_chain(), 4, noise=False).to_table()
    table.remove_columns(["altitude", "parallactic"])
    with pytest.raises(ObservationError, match="a star needs its pointing"):
        CHARIS.prepare(Observations.from_table(table, name="lost"))


def test_pointing_from_time_and_target_takes_the_instruments_site():
    table = observe_star(star_chain(), 2, altitude=(60, 60.5), noise=False).to_table()
    table.remove_columns(["altitude", "parallactic"])
    seconds = np.asarray(table["frame"]) * 12
    start = np.datetime64("2025-11-03T11:00:00")
    table["time"] = (start + seconds.astype("timedelta64[s]")).astype(str)
    table.meta |= {"right_ascension": 107.25, "declination": -1.0}
    star = Observations.from_table(table, name="star")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        positions = CHARIS.positions(CHARIS.prepare(star), star_chain())
    assert set(positions) == {"hwp", "derotator", "parallactic", "altitude"}
    assert 0 < np.rad2deg(positions["altitude"]).min() < 75


def test_positions_of_an_exposure_have_nodes():
    star = observe_star(star_chain(), 2, noise=False)
    positions = CHARIS.positions(star, star_chain(), nodes=3, duty=0.9)
    assert {angle.shape for angle in positions.values()} == {(3, 8)}
