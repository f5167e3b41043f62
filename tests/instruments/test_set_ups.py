# Licensed under a 3-clause BSD style license - see LICENSE
"""Set-ups of the package's own instruments: dates, modulators, kinds of optics."""

import warnings
from datetime import date
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import QTable
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import instruments, optics
from astropolcal.chain import leaves
from astropolcal.exceptions import AstropolcalWarning, InstrumentError
from astropolcal.instruments import SkyLaw
from astropolcal.instruments.telescope import k_mirror, star_options
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS, VAMPIRES, IRDIS = (instruments.get(name) for name in ("charis", "vampires", "irdis"))


# --- what headers tell of the beam ------------------------------------------------------------


def test_beam_switcher_by_the_date_of_a_header():
    for header, found in [
        ({"MJD": Time("2025-07-31T23:59:00").mjd}, {"nbs": False}),
        ({"MJD": Time("2025-10-01T00:01:00").mjd}, {"nbs": True}),
        ({"UTC-DATE": "2025-07-15", "UTC-TIME": "10:00:00"}, {"nbs": False}),
        ({"DATE-OBS": "2026-01-02"}, {"nbs": True}),
        ({"MJD": Time("2025-09-01").mjd}, {}),
        ({"MJD": "tonight"}, {}),
        ({}, {}),
    ]:
        assert CHARIS.optics_of(header) == found, (header, found)


def test_liquid_crystal_by_a_word_of_a_header():
    for word, found in [
        ("IN", {"flc": True}),
        ("Out of beam", {"flc": False}),
        (" in ", {"flc": True}),
        ("moving", {}),
        ("", {}),
    ]:
        assert VAMPIRES.optics_of({"U_FLCST": word}) == found, (word, found)


# --- kinds of optics ----------------------------------------------------------------------------


def free_names(chain):
    return {
        f"{o.name}.{k}" for o in leaves(chain) for k in o.param_names if not getattr(o, k).fixed
    }


def test_derotator_of_three_mirrors():
    """A film and two factors in the place of 66 retardances, held by the scatter of real films."""
    chain = CHARIS.chain(derotator="kmirror")
    mirrors = chain["derotator"]
    assert isinstance(mirrors, optics.KMirror)
    own = {name for name in free_names(chain) if name.startswith("derotator.")}
    assert own == {f"derotator.{k}" for k in ("theta", "film_thickness", "n_scale", "k_scale")}
    assert (mirrors.n_scale.prior.mean(), mirrors.n_scale.prior.std()) == (1, 0.5)
    assert (mirrors.k_scale.prior.mean(), mirrors.k_scale.prior.std()) == (1, 0.1)
    assert mirrors.theta.bounds == (-5, 5)


def test_settings_of_a_k_mirror_go_before_the_usual_ones():
    held = k_mirror(fixed={"n_scale": True}, bounds={"film_thickness": (100, 300)}, name="k")
    assert held.n_scale.fixed
    assert not held.k_scale.fixed
    assert held.film_thickness.bounds == (100, 300)
    assert held.k_scale.bounds == (0.5, 2)


def test_retardances_of_the_published_derotator_are_between_its_bins():
    """Starts on another grid are interpolated, and the same at the published bins."""
    whole = CHARIS.chain()["derotator"].horizontal.value
    part = CHARIS.chain(wavelength=CHARIS.wavelength[[3, 7]])["derotator"].horizontal.value
    np.testing.assert_allclose(part, whole[[3, 7]])
    middle = 0.5 * (CHARIS.wavelength[3] + CHARIS.wavelength[4])
    between = float(CHARIS.chain(wavelength=middle)["derotator"].horizontal.value)
    assert between == pytest.approx(0.5 * (whole[3] + whole[4]))


def test_optional_optics_stand_behind_the_derotator():
    for name in ["nbs", "dichroic"]:
        names = CHARIS.chain(optics_in=[name]).submodel_names
        assert names.index("derotator") < names.index(name) < names.index("wollaston"), name


# --- frames that no calibration should use ------------------------------------------------------


def lamp(instrument, flux, **meta):
    """Frames of an internal source whose lamp changes from frame to frame."""
    chain = instrument.chain(wavelength=instrument.wavelength[:2])
    cycles = half_wave_plate_cycles()
    frames = QTable({name: np.repeat(cycles[name], 2) for name in cycles.colnames})
    frames["flc_state"] = np.tile([0.0, 1.0], len(cycles))
    meta = instrument.published_meta() | meta
    return simulate(
        chain, instrument.wavelength[:2], frames, flux=flux, noise=False, meta=meta, name="lamp"
    )


def test_lamp_that_drifts_is_no_matter_between_states_of_a_crystal():
    """Both states of a pair follow one another at once: nothing is masked for a slow drift."""
    table = lamp(VAMPIRES, 1e6).to_table()
    drift = np.where(table["frame"] >= 8, 1.5, 1.0)
    for name in ("flux_right", "flux_left"):
        table[name] = table[name] * drift
    observations = type(lamp(VAMPIRES, 1e6)).from_table(table, name="lamp")
    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropolcalWarning)
        prepared = VAMPIRES.prepare(observations)
    assert prepared.n_frames == observations.n_frames


# --- laws, coatings, stars ----------------------------------------------------------------------


def test_law_that_depends_on_the_mode_needs_it():
    law = SkyLaw(plate={"field": (-1, 1), "pupil": (-0.5, 1)})
    with pytest.raises(InstrumentError, match="mode = None; allowed are field, pupil"):
        law.plate_law()
    assert SkyLaw(plate={"field": (1, 1), "pupil": (1, 1)}).plate_law() == (1.0, 1.0)


@given(day=st.dates(date(2014, 1, 1), date(2026, 1, 1)))
def test_coating_is_that_of_the_day(day):
    """One day decides; a text, a date and a time of it say the same."""
    expected = "before" if day.isoformat() < IRDIS.recoating else "after"
    assert IRDIS.coating_on(day) == expected
    assert IRDIS.coating_on(day.isoformat()) == expected
    assert IRDIS.coating_on(Time(f"{day.isoformat()}T12:00:00")) == expected


def test_name_of_a_star_makes_the_name_of_its_optic():
    for name, optic in [
        ("HD 30675", "star_HD30675"),
        ("GJ-3", "star_GJ3"),
        ("* alf Lyr", "star_alfLyr"),
        (7, "star_7"),
    ]:
        observations = SimpleNamespace(source="star", meta={"object": name})
        found = star_options(observations)
        assert found == {"star": optic, "target": str(name)}, (name, optic)
        assert found["star"].isidentifier(), (name, optic)
