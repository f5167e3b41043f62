# Licensed under a 3-clause BSD style license - see LICENSE
"""How half-wave plate and derotator follow the sky, for every instrument."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import instruments, mueller, optics
from astropolcal.chain import leaves, stages
from astropolcal.exceptions import InstrumentError
from astropolcal.instruments import Instrument, SkyLaw
from astropolcal.observations import Observations
from astropolcal.observations.pointings import TRACKING


class Plain(Instrument):
    """A chain from the sky with a law of its own, set by a test."""

    name = "plain"

    def chain(self, source="star", optics_in=(), *, wavelength=None):
        return (
            optics.Rotator(mount="parallactic", name="parallactic")
            | optics.Rotator(mount="altitude", name="altitude")
            | optics.LinearRetarder(mount="hwp", name="hwp")
            | optics.WollastonPrism(name="wollaston")
        )

    def setup(self, observations):
        return "star", ()


def table(n=4, **meta):
    frames = QTable({"frame": np.arange(n), "bin": np.zeros(n, int)})
    frames["wavelength"] = 1.6 * u.um
    frames["hwp"] = np.resize([0, 45, 22.5, 67.5], n) * u.deg
    frames["derotator"] = np.zeros(n) * u.deg
    frames["parallactic"] = np.linspace(-30, 40, n) * u.deg
    frames["altitude"] = np.linspace(40, 60, n) * u.deg
    frames["flux_right"] = frames["flux_left"] = np.ones(n) * u.adu
    frames.meta = meta
    return frames


def plate(law, frames):
    """Angles of the plate that an instrument of this law reads from a table."""
    instrument = Plain()
    type(instrument).sky_law = law
    observations = Observations.from_table(frames, name="night")
    return np.rad2deg(instrument.positions(observations, instrument.chain())["hwp"])


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_positions_obey_the_law_of_the_instrument(f, g):
    frames = table()
    expected = frames["hwp"] + f * frames["parallactic"] + g * frames["altitude"]
    np.testing.assert_allclose(plate(SkyLaw(plate=(f, g)), frames), expected.to_value(u.deg))


def test_true_angle_of_the_plate_counts_more_than_any_law():
    frames = table()
    frames["hwp_true"] = [10, 20, 30, 40] * u.deg
    for law in (SkyLaw(), SkyLaw(plate=(0, 0)), SkyLaw({"field": (1, 1), "pupil": (0, 0)})):
        np.testing.assert_allclose(plate(law, frames), [10, 20, 30, 40])


def test_law_that_depends_on_the_mode_asks_for_it():
    law = SkyLaw(plate={"field": (-1, 1), "pupil": (-0.5, 1)})
    commanded = plate(SkyLaw(plate=(0, 0)), table())
    for mode, f in (("field", -1.0), ("pupil", -0.5)):
        frames = table(tracking=mode)
        expected = f * frames["parallactic"] + frames["altitude"]
        np.testing.assert_allclose(plate(law, frames) - commanded, expected.to_value(u.deg))
    with pytest.raises(InstrumentError, match=r"night: tracking is 'sky'.*one of pupil, field"):
        plate(law, table(tracking="sky"))


def test_laws_that_are_none_are_refused():
    for wrong in (1, (1,), (1, 2, 3), ("a", 1), (np.nan, 0), (np.inf, 0), None, {}):
        with pytest.raises(InstrumentError, match="plate"):
            SkyLaw(plate=wrong)
    with pytest.raises(InstrumentError, match="derotator field"):
        SkyLaw(derotator={"field": "x"})
    with pytest.raises(InstrumentError, match="the plate has a law for sky, the derotator for"):
        SkyLaw(plate={"sky": (1, 1)})
    with pytest.raises(InstrumentError, match="no derotator that follows"):
        SkyLaw(derotator={}).derotator_law("field")
    with pytest.raises(InstrumentError, match="law = 'sky'; allowed are pupil, field"):
        SkyLaw().derotator_law("sky")
    with pytest.raises(InstrumentError, match="mode = 'sky'; allowed are pupil, field"):
        SkyLaw().plate_law("sky")


def test_law_of_a_file_layout_is_the_instruments():
    charis = instruments.get("charis")
    assert charis.sky_law.plate_law() == charis.files.tracking == TRACKING
    assert charis.sky_law.modes == ("pupil", "field")


def test_plate_and_derotator_keep_what_they_should():
    """With ideal optics the direction that is measured stands still on the sky."""
    for name, mode in [("charis", "pupil"), ("irdis", "field"), ("irdis", "pupil")]:
        instrument = instruments.get(name)
        train = leaves(instrument.chain("star", wavelength=instrument.wavelength[:1]))[1:-1]
        law = instrument.sky_law
        laws = {"hwp": law.plate_law(mode), "derotator": law.derotator_law(mode)}

        def measured(p, a, train=train, laws=laws):
            at = {stage: f * p + g * a for stage, (f, g) in laws.items()}
            at |= {"parallactic": p, "altitude": a}
            total = np.eye(4)
            for leaf in train:
                turn = leaf.stage_sign * at[leaf.stage] if leaf.stage else 0.0
                ideal = mueller.rotation_matrix(turn * u.deg)
                if not isinstance(leaf, optics.Rotator):
                    ideal = ideal.T @ mueller.linear_retarder(180 * u.deg) @ ideal
                total = ideal @ total
            return np.rad2deg(np.arctan2(total[2, 1], total[1, 1])) / 2

        start, turned, higher = measured(0, 50), measured(20, 50), measured(0, 70)
        assert (higher - start + 90) % 180 == pytest.approx(90), (name, mode)
        assert (turned - start + 90) % 180 == pytest.approx(90), (name, mode)
        assert {"parallactic", "altitude"} <= set(stages(instrument.chain("star"))), (name, mode)
