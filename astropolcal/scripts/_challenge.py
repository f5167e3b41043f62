# Licensed under a 3-clause BSD style license - see LICENSE
"""
Test the diagnosis, or another tool, on sealed simulated data.

Their faults are random, and the answers are compared with the truth.

For example::

  astropolcal challenge -n 20
  astropolcal challenge run -n 1000 --workers 8 --checkpoint run.jsonl
  astropolcal challenge make cases --count 100 --seed 7
  astropolcal challenge score cases outputs

A run that was interrupted goes on if it is started again with the same
checkpoint.
"""

from astropolcal.exceptions import GapError
from astropolcal.progress import in_one_thread
from astropolcal.scripts import _common as common
from astropolcal.words import counted

OPTIONS = """
action {run,make,score} ? =run  run: make, diagnose and score (default); make DIR: write cases to
    files; score DIR OUTPUTS: score the answers of any tool to them
folders FOLDER *  of the cases, and of the answers
-n --count N int =20  how many (default: %(default)s)
--seed S int =0  default: %(default)s
--snr LOW:HIGH range =12:120  signal-to-noise ratio of each fault (default: 12:120)
--kinds KIND,KIND,... kinds  none, cell, listed, pair, detector, frame, mechanism, absorbed
    (default: all)
--instrument NAME =charis  default: %(default)s
--wavelengths N int =8  default: 8
--derotator-angles N int =8  default: 8
--checkpoint FILE Continued  append each outcome of a run to this file, and go on from it
--workers N int =1  processes; default: 1
--cluster ADDRESS  scheduler of dask.distributed, in place of processes
--reliability FILE Drawing  draw how many causes are right against their probability (PNG, PDF or
    SVG)
@ json quiet
"""


TYPES = {
    "range": common.text_type("of the form LOW:HIGH", common.numbers, 2, ":"),
    "kinds": lambda text: text.split(","),
}


@in_one_thread
def run(arguments):
    """Make, run or score challenges, print how they went and write what was asked for."""
    from astropolcal.gap.challenge import KINDS, Setup, make_cases, run_challenge, score_cases

    action, folders = arguments.action, arguments.folders
    wanted = {"run": 0, "make": 1, "score": 2}[action]
    if len(folders) != wanted:
        raise GapError(
            f"challenge {action} takes {counted(wanted, 'folder')}, {len(folders)} given"
        )
    for name in {"make": ("reliability", "checkpoint", "json")}.get(action, ()):
        if (path := getattr(arguments, name)) is not None:
            raise GapError(
                f"--{name} {path}: is for challenge run; what is made is written to {folders[0]}"
            )
    if action == "score":
        result = score_cases(*folders)
    else:
        options = {
            "n": arguments.count,
            "seed": arguments.seed,
            "snr": arguments.snr,
            "kinds": arguments.kinds or tuple(KINDS),
            "setup": Setup(
                instrument=arguments.instrument,
                n_wavelengths=arguments.wavelengths,
                n_derotator=arguments.derotator_angles,
            ),
        }
        options |= {"workers": arguments.workers, "cluster": arguments.cluster}
        if action == "make":
            key = make_cases(folders[0], **options)
            words = f"{counted(len(key), 'case')} and key.json written to {folders[0]}"
            common.say(arguments, words)
            return
        result = run_challenge(**options, checkpoint=arguments.checkpoint)
    if arguments.reliability:
        from astropolcal.plotting._style import save

        save(result.plot_reliability(), arguments.reliability)
    common.give(arguments, [_report(result)], result.to_dict())


def _report(result):
    """Return the tables, and what was not right one by one."""
    lines = [result.words(), ""]
    for record in result.failures:
        # only what went wrong is listed; the rates hold the rest
        truth = " + ".join(record["faults"]) or "nothing"
        answer = f"{record['verdict']} {' + '.join(record['causes'])}".strip()
        line = (
            f"  no. {record['index']}, {record['result']}: {record['kind']} {truth} "
            f"(SNR {record['snr']:.0f}) -> {answer}"
        )
        lines.append(common.wrapped(line, indent=6))
    return "\n".join(lines).rstrip()
