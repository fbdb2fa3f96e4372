"""Which frequencies, how many steps? A plan of a frame budget, chosen by what it can reach at best.

A plan of frequencies f_t with N steps each is judged by three bounds, all for a pixel of modulation B and frames of
noise σ, with m_t the contrast that projector and lens leave at f_t:

* *coordinate*: Cramér-Rao, σ_u = √(2/N) (σ/B) / (2π √Σ m_t² f_t²) (method.md §1; Kay, *Estimation Theory*, §3.4);
* *fringe order*: the probability that noise lifts a side lobe of the likelihood above the true place, summed over the
  side lobes (union bound);
* *detection*: a bounce of amplitude ratio α at Δu leaves ``α m_t e^{i2πf_t Δu}`` less what the one-path fit takes of it
  (to first order: amplitude and coordinate). Over the noise its square is the noncentrality of the fit's χ², and gives
  the power at a false-alarm rate (Kay, *Detection Theory*, §2.2.3). Since it grows with α², one figure says all: the
  *least bounce* α₅₀(Δu), found every other time.

The bounce is taken to be displaced along one axis only, which is the harder case; χ² of all axes is tested.
"""

from scanner.design.bounds import (
    AxisBounds,
    bounds,
    contrast,
    coordinate_bound,
    detection_power,
    even_noncentrality,
    noncentrality,
    wrong_order_probability,
)
from scanner.design.demand import Demand, DesignError
from scanner.design.designed import DesignedPlan, judge
from scanner.design.search import design, trade

__all__ = [
    "AxisBounds",
    "Demand",
    "DesignError",
    "DesignedPlan",
    "bounds",
    "contrast",
    "coordinate_bound",
    "design",
    "detection_power",
    "even_noncentrality",
    "judge",
    "noncentrality",
    "trade",
    "wrong_order_probability",
]
