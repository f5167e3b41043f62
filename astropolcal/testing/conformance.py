# Licensed under a 3-clause BSD style license - see LICENSE
"""Applying the rules to an instrument, and the report of what was found."""

import inspect
import warnings
from dataclasses import dataclass, field

from astropolcal.exceptions import InstrumentError
from astropolcal.instruments import Instrument
from astropolcal.testing._rules import Absent, Broken, Probe

__all__ = ["RULES", "Conformance", "check_instrument"]

RULES = {
    "class": "it is an Instrument, its name is one word, and it answers to name and aliases",
    "documentation": "its class has a docstring, and references say where the values are from",
    "wavelengths": "they are lengths, each positive, finite and another",
    "sources": "a chain is built for each of its sources, and an unknown source is refused",
    "names": "every optic has a name of its own, and one of them splits the light",
    "bounds": "starting values are finite, within their bounds and as many as the wavelengths",
    "physical": "every optic is physical, at random positions, and so is the whole",
    "on sky": "a chain from the sky starts with the telescope, and nothing of the source is in it",
    "mounts": "the position of every stage is a column of tables, or comes from a keyword",
    "headers": "keywords are those of FITS, differ, and are the same in the file layout",
    "setup": "a table is told source and optics of its chain, and a strange one is refused",
    "published": "published values are within their bounds and physical, and their meta fit",
    "round trip": "every chain is the same after an ASDF file",
    "predicts": "both beams change with the modulator, and positions are those of the frames",
    "calibrates": "a calibration of simulated frames predicts frames that it did not see",
}


@dataclass
class Conformance:
    """
    What `check_instrument` found.

    Attributes
    ----------
    name : str
        Of the instrument.
    passed : list of str
        Rules that hold.
    failed : dict of str to str
        Rule to what is wrong.
    skipped : dict of str to str
        Rule to why it was not checked.

    Examples
    --------
    >>> from astropolcal.testing import Conformance
    >>> report = Conformance("mine", ["class"], {"headers": "twice the same keyword 'HWP'"})
    >>> bool(report)
    False
    >>> print(report)
    mine fails 1 of 2 rules
    - headers: twice the same keyword 'HWP'
    """

    name: str
    passed: list = field(default_factory=list)
    failed: dict = field(default_factory=dict)
    skipped: dict = field(default_factory=dict)

    def __bool__(self):
        return not self.failed

    def __str__(self):
        count = len(self.passed) + len(self.failed)
        words = f"fails {len(self.failed)} of {count} rules" if self.failed else "passes"
        lines = [f"{self.name} {words}" + ("" if self.failed else f" {count} rules")]
        lines += [f"- {rule}: {what}" for rule, what in self.failed.items()]
        lines += [f"- {rule} not checked: {why}" for rule, why in self.skipped.items()]
        return "\n".join(lines)


def check_instrument(instrument, *, skip=(), seed=0, raises=True):
    """
    Check that an instrument conforms to what calibration, correction and files rely on.

    Parameters
    ----------
    instrument : Instrument or type
        The instrument, or its class; it need not be registered.
    skip : sequence of str
        Rules that are left out, see `RULES`.
    seed : int
        Of the random positions and of the noise.
    raises : bool
        Whether a rule that fails is an error.

    Returns
    -------
    Conformance
        Rules that hold, fail, or were not checked.

    Raises
    ------
    InstrumentError
        If a rule fails; the message names every one and what is wrong. Or if a rule to
        be skipped is unknown.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.testing import check_instrument
    >>> print(check_instrument(instruments.get("irdis"), skip=["calibrates"]))
    irdis passes 14 rules
    - calibrates not checked: skipped
    """
    unknown = sorted(set(skip) - set(RULES))
    if unknown:
        raise InstrumentError(f"no rules {unknown}; there are {', '.join(RULES)}")
    if inspect.isabstract(instrument):
        lacking = ", ".join(sorted(instrument.__abstractmethods__))
        raise InstrumentError(f"class: {instrument.__name__} lacks the methods {lacking}")
    if inspect.isclass(instrument):
        instrument = instrument()
    if not isinstance(instrument, Instrument):
        raise InstrumentError(f"class: {instrument!r} is not an Instrument, nor a class of one")
    report = Conformance(instrument.name or type(instrument).__name__)
    probe = Probe(instrument, seed)
    for rule in RULES:
        if rule in skip:
            report.skipped[rule] = "skipped"
        elif rule not in ("class", "documentation", "headers") and report.failed.get("sources"):
            report.skipped[rule] = "there are no chains"
        else:
            _apply(rule, probe, report)
    if raises and not report:
        raise InstrumentError(str(report))
    return report


def _apply(rule, probe, report):
    try:
        with warnings.catch_warnings():
            # what an instrument warns of is for its users, not a breach of a rule
            warnings.simplefilter("ignore")
            getattr(probe, f"check_{rule.replace(' ', '_')}")()
    except Absent as absent:
        report.skipped[rule] = str(absent)
    except Broken as broken:
        report.failed[rule] = str(broken)
    except Exception as error:  # whatever the code of an instrument raises is a finding
        report.failed[rule] = f"{type(error).__name__}: {error}"
    else:
        report.passed.append(rule)
