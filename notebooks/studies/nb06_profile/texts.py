"""What the notebook says under its figures: captions, and readings whose numbers come from the run."""

from collections.abc import Mapping, Sequence

from torch import Tensor

from motionlab.humor.testops import Schedule
from studies.nb06_profile.official_profile import Official

Parts = Mapping[str, Mapping[str, float]]


# ----------------------------------------------------------------------------------------------------------- captions
def bars(frames: int) -> str:
    """Returns the caption of the bars of one closure."""
    return (
        f"One closure of stage 3 in either form, on one axis (n = 1 closure each; {frames} frames). *First state*: "
        "pose and body of frame 0. *Body*: joints and keypoints of all frames. *Terms*: the energies."
    )


def phases(rounds: int, frames: int) -> str:
    """Returns the caption of the minutes by phase."""
    return (
        "Minutes of the official schedule for one clip on one CPU core, all on one axis (official code: n = 1 profile; "
        f"ours: median of n = {rounds} rounds, {frames} frames). *Roll-out function*: first state and chain, forward."
    )


def shares(rounds: int) -> str:
    """Returns the caption of the shares."""
    return (
        "Shares of time. Line: the thesis. Grey: within 10 points of it; in the last row, half and more. Whiskers: "
        f"95 % intervals of n = {rounds} rounds. Official code: n = 1, with the drift between its runs in the last row."
    )


def growth(rounds: int, wide: int, frames: int) -> str:
    """Returns the caption of the curves."""
    return (
        f"Processor time of a closure of stage 3 (batches: {frames} frames). Dots: single measurements, n = {rounds} "
        f"rounds on the left and {wide} on the right. Bands: 95 % of the posterior; exponents with 95 % intervals."
    )


def memory(frames: int) -> str:
    """Returns the caption of the memory."""
    return (
        f"Memory of closures of stage 3 against the batch ({frames} frames), carried on straight to 11 GiB. Every dot "
        "is n = 1 process or count. In the legend: the clips that would fit there."
    )


def ladder(rounds: int, frames: int) -> str:
    """Returns the caption of the rungs."""
    return (
        f"One closure of stage 3 on every rung ({frames} frames, one clip): median and quartiles of n = {rounds} "
        "rounds. Factors: over the rung above and, in brackets, over the first."
    )


# ----------------------------------------------------------------------------------------------------------- readings
def closure(seconds: Parts) -> str:
    """Says what the bars of the two forms show."""
    first, second = list(seconds.values())[:2]
    whole, less = sum(first.values()), sum(second.values())
    longest = max(first, key=first.get)
    expected = "as expected" if longest == "backward" else f"not as expected: the longest part is the {longest}"
    return (
        f"**Reading.** Backward takes {100 * first['backward'] / whole:.0f} % of the faithful closure, {expected}. "
        f"The lean form takes {1e3 * less:.0f} ms instead of {1e3 * whole:,.0f} ms."
    )


def minutes(official: float, took: Mapping[str, Tensor], counted: Sequence[int], frames: int) -> str:
    """Says how long the schedule takes, beside the thesis's minutes, and how long a clip of so many frames takes."""
    ours = {form: took[form].median().item() for form in ("faithful", "lean")}
    schedule = Schedule()
    step = schedule.window - schedule.overlap
    windows = max(1, -(-(frames - schedule.overlap) // step))
    return (
        f"**Reading.** On one CPU core the official code takes {official:.1f} min at most, our imitation "
        f"{ours['faithful']:.1f} min, the lean form {ours['lean']:.1f} min. The thesis's 20 min are a GTX 1080 Ti's, "
        "so that these numbers neither confirm nor refute it.\n\n"
        f"An outer step took {sum(counted) / len(counted):.0f} closures where we counted (n = {len(counted)} steps), "
        f"of the 25 that it may. A clip of {frames} frames is fitted in {windows} window{'s' * (windows > 1)}: at most "
        f"{windows * ours['faithful']:,.0f} min in faithful and {windows * ours['lean']:,.0f} min in lean form."
    )


def cause(official: Official, ours: float, gap: float) -> str:
    """Says whether the roll-out is half of a closure."""
    share = official.shares()["roll-out and its gradient"]
    low, high = official.range(share)
    inside = "lies inside, so that one profile cannot decide" if low < 50 < high else "lies outside"
    stand = "it is no stand-in" if abs(gap) > 10 else "it may stand in for it"
    return (
        f"**Reading.** In the official code the roll-out takes **{share:.0f} %** of the closure. With the drift of "
        f"{100 * official.drift:.0f} % between its runs it may be {low:.0f} % to {high:.0f} %. The bound of 50 % "
        f"{inside}. Our imitation says {ours:.0f} %, {gap:+.0f} points away: {stand}."
    )


def claimed(rows: Sequence[Mapping[str, object]]) -> str:
    """Says which shares of the official code are far from the thesis's: rows of ``program.claimed``."""
    off = ", ".join(str(row["share"]) for row in rows if abs(row["official code, %"] - row["thesis, %"]) > 10)
    return f"**Reading.** More than 10 points off in the official code: {off or 'none'}."


def clocks(rows: Sequence[Mapping[str, str]]) -> str:
    """Says by how many points two clocks differ at most: rows of the same form, one after the other."""
    pairs = zip(rows[::2], rows[1::2], strict=True)
    apart = max(abs(float(a[key]) - float(b[key])) for a, b in pairs for key in a if key.endswith("%"))
    then = "either may be read" if apart <= 10 else "the stopwatch, which slows nothing down, is to be read"
    return f"**Reading.** The two clocks differ by {apart:.0f} points at most, so that {then}."


def grows(exponent: float, official: float, many: int, together: Mapping[str, Tensor]) -> str:
    """Says how time grows with frames and with clips."""
    ours = {form: x.median().item() for form, x in together.items()}
    return (
        f"**Reading.** The faithful time grows with the frames to the power {exponent:.2f}. Four clips cost the "
        f"official code {official:.1f} times as much as one. A batch of {many} costs our imitation "
        f"{ours['faithful']:.1f} times as much as one clip, and the lean form {ours['lean']:.1f} times. A GPU works on "
        "the clips of a batch side by side, so that the thesis's batch may well be free. A CPU core cannot say."
    )


def fits(official: float, fits: Mapping[str, float]) -> str:
    """Says how many clips fit into 11 GiB, by either count."""
    return (
        f"**Reading.** By RSS, 11 GiB hold {official:.0f} clips of the official code and "
        f"{fits['faithful, RSS']:,.0f} of our imitation. Live tensors alone would say "
        f"{fits['faithful, live tensors']:,.0f}. RSS counts, since a process needs all that it takes. But the process "
        "of a CPU is not the memory of a card, so that the thesis's four clips stay undecided."
    )


def saved(ratio: Tensor, batch: int, more: float, heading: float, rest: float) -> str:
    """Says what the rungs saved, and what they change for a trained prior."""
    return (
        f"**Reading.** The last rung is **{ratio.median():.1f} times** faster than the first (rounds from "
        f"{ratio.min():.1f} to {ratio.max():.1f}). A batch of {batch} makes it {more:.1f} times faster still for each "
        f"clip. With trained priors the exact heading changes the energy by {heading:.0e} of the size of its terms, "
        f"all other rungs by {rest:.0e} at most."
    )
