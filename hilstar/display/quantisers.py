"""Every quantisation by the name that the bench file gives it."""

from hilstar.display.exact import ExactQuantiser
from hilstar.display.quantise import DitherQuantiser, Quantisation, Quantiser, RoundQuantiser
from hilstar.display.temporal import TemporalQuantiser

QUANTISERS: dict[Quantisation, type[Quantiser]] = {
    "round": RoundQuantiser,
    "dither": DitherQuantiser,
    "exact": ExactQuantiser,
    "temporal": TemporalQuantiser,
}
# what `auto` chooses among, from the cheapest to the most accurate
BY_COST: tuple[Quantisation, ...] = ("round", "exact")
