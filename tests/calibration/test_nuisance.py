# Licensed under a 3-clause BSD style license - see LICENSE
"""What differs between datasets: background, gains of the beams, polarization of a lamp."""

import astropy.units as u
import numpy as np
import pytest
from star_data import CHARIS, WAVELENGTH

from astropolcal import calibrate, optics
from astropolcal.chain import leaves
from astropolcal.exceptions import InstrumentError
from astropolcal.instruments import add_nuisance
from astropolcal.instruments.base import NUISANCES, without_nuisance
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles, simulate

FRAMES = half_wave_plate_cycles(derotator=[45, 58, 70, 85, 100, 116] * u.deg)
LAMP = {"source": "unpolarized", "nasmyth_beam_switcher": "installed", "yjh50_dichroic": "in"}
POLARIZED = LAMP | {"source": "polarized"}


def chain_of(meta, **options):
    options = {"wavelength": WAVELENGTH, "derotator": "linear"} | options
    return CHARIS.chain(meta["source"], ["dichroic", "nbs"], **options)


def observe(chain, meta, name, added=0.0, gain=0.0, **options):
    """Simulate a run, with light added to every frame and one beam brighter than the other."""
    seen = simulate(chain, WAVELENGTH, FRAMES, meta=meta, name=name, **options)
    table = seen.to_table()
    unit = table["flux_right"].unit or 1
    table["flux_right"] = (table["flux_right"] + added * unit) * (1 + gain)
    table["flux_left"] = (table["flux_left"] + added * unit) * (1 - gain)
    return Observations.from_table(table, name=name)


def names(chain):
    return [leaf.name for leaf in leaves(chain)]


def test_each_kind_stands_where_it_belongs():
    run = observe(chain_of(LAMP), LAMP, "run 7", seed=1)
    (chain,) = CHARIS.chains_for([run], nuisance=list(NUISANCES), derotator="linear")
    assert names(chain) == ["lamp_run_7", "fold_mirror", "hwp", "derotator", "dichroic", "nbs",
                            "background_run_7", "wollaston", "beam_gain_run_7"]  # fmt: skip
    assert chain["background_run_7"].amount.shape == (3,)
    assert chain["background_run_7"].amount.prior.std() == NUISANCES["background"]
    assert names(without_nuisance(chain)) == names(chain_of(LAMP))
    sky = names(CHARIS.on_sky(chain))
    assert not [name for name in sky if "run_7" in name]


def test_one_dataset_may_have_what_others_have_not():
    runs = [observe(chain_of(meta), meta, meta["source"], seed=1) for meta in (POLARIZED, LAMP)]
    first, second = CHARIS.chains_for(runs, nuisance=["background:unpolarized"])
    assert "background_unpolarized" in names(second)
    assert names(first) == names(without_nuisance(first))


def test_datasets_of_one_name_have_optics_of_their_own():
    for labels in (("run", "run"), ("run", "run", "run_1")):
        runs = [observe(chain_of(POLARIZED), POLARIZED, name, seed=1) for name in labels]
        found = [names(chain)[-2] for chain in CHARIS.chains_for(runs, nuisance=["background"])]
        assert found[:2] == ["background_run_1", "background_run_2"]
        assert len(set(found)) == len(labels)


def test_what_does_not_fit_is_refused():
    for nuisance, words in [
        ("fog", "nuisance = 'fog'; allowed are background, beam_gain, lamp"),
        ("background:b", "dataset = 'b'; allowed are"),
        ("lamp", "no dataset is of an unpolarized internal source"),
    ]:
        run = observe(chain_of(POLARIZED), POLARIZED, "a", seed=1)
        with pytest.raises(InstrumentError, match=words):
            add_nuisance([chain_of(POLARIZED)], [run], [nuisance])


def test_background_comes_back_and_its_bias_goes():
    """The lamp fades by a factor of three, so that the same background counts for more."""
    truth = chain_of(POLARIZED)
    fading = np.linspace(1.5, 0.5, len(FRAMES))
    run = observe(truth, POLARIZED, "run", added=3e4, lamp=fading, flux=1e7, seed=4)
    reference = float(np.median(run.position("total_flux")))
    (chain,) = CHARIS.chains_for([run], nuisance=["background"], derotator="linear")
    found = calibrate(chain, run, cross_validate=False, weights="errors")
    without = calibrate(chain_of(POLARIZED), run, cross_validate=False, weights="errors")
    entry = found.parameter_values()["background_run.amount"]
    # the share is of light before the beam splitter, which halves it
    expected = 2 * 3e4 / reference
    off = (entry["value"] - expected) / entry["std"]
    assert np.abs(off).max() < 4
    assert entry["std"].max() < 0.2 * expected
    efficiency = [c.chains[0]["wollaston"].efficiency.value for c in (found, without)]
    true = truth["wollaston"].efficiency.value
    assert np.abs(efficiency[0] - true).max() < 0.2 * np.abs(efficiency[1] - true).min()


def test_gain_of_the_beams_comes_back_from_single_differences():
    run = observe(chain_of(POLARIZED), POLARIZED, "run", gain=0.02, seed=4)
    (chain,) = CHARIS.chains_for([run], nuisance=["beam_gain"], derotator="linear")
    found = calibrate(
        chain, run, observable="normalized_single_difference", weights="errors",
        cross_validate=False,
    )  # fmt: skip
    entry = found.parameter_values()["beam_gain_run.imbalance"]
    np.testing.assert_allclose(entry["value"], 0.02, atol=4e-4)


def test_lamp_that_is_not_unpolarized():
    """u is measured; q is not told from the fold mirror, and has the width of its prior."""
    truth = chain_of(LAMP)
    truth["fold_mirror"].diattenuation = [0.012, 0.010, 0.008]
    lamp = optics.PolarizedSource(q=0.0, u=0.003, name="lamp") | truth
    runs = [
        observe(chain_of(POLARIZED), POLARIZED, "polarized", seed=1),
        observe(lamp, LAMP, "unpolarized", seed=2),
    ]
    chains = CHARIS.chains_for(runs, nuisance=["lamp"], derotator="linear")
    # straight, so that the lamp's frame is known
    for name in ("hwp", "derotator"):
        for chain in chains:
            chain[name].theta.fixed = True
    known = calibrate(chains, runs, cross_validate=False, weights="errors").parameter_values()
    q, stokes_u = (known[f"lamp_unpolarized.{key}"] for key in "qu")
    assert abs(stokes_u["value"] - 0.003) < 4 * stokes_u["std"] < 1e-3
    assert q["std"] == pytest.approx(NUISANCES["lamp"], rel=0.1)
