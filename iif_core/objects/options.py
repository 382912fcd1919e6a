"""Options of what makes objects, apart from their code, so that reading them loads no compiler."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PieceOptions:
    """How a mesh is cut into pieces.

    Attributes:
        scale: of the regions; a larger one gives fewer and larger pieces.
        colour: weight of differences in colour between faces, relative to the angle between them; 0 = shape alone.
        min_faces: pieces of fewer faces join a neighbour, unless they have `min_area`.
        min_area: m^2 from which a piece stays as it is, however few faces it has.
    """

    scale: float = 0.05
    colour: float = 0.1
    min_faces: int = 100
    min_area: float = 0.01


@dataclass(frozen=True)
class BorderOptions:
    """Which pixels count as the border of an object.

    Attributes:
        border_erosion: width in pixels of the border along another object, 0 = there is none.
    """

    border_erosion: int = 1


@dataclass(frozen=True)
class ProposalOptions:
    """Which masks of a promptable model are kept.

    Attributes:
        points_per_side: points along each side of the grid at which the model is queried in every photograph.
        confidence: masks with a smaller predicted intersection over union with the truth are dropped.
        stability: masks that shrink below this share when the threshold on the logits rises from -1 to 1 are dropped.
        overlap: of masks with a larger intersection over union, only the most confident is kept.
    """

    points_per_side: int = 32
    confidence: float = 0.8
    stability: float = 0.95
    overlap: float = 0.7


@dataclass(frozen=True)
class ConsensusOptions:
    """Thresholds of the clustering; shares in (0, 1].

    Attributes:
        visible: share of a mask that a view must see (Eq. O.8).
        contained: share of the points that one mask must hold to contain them (Eq. O.9).
        split: share of the views that can judge a mask above which a split mask is dropped (Eq. O.10).
        consensus: smallest ratio of supporters to observers (Eq. O.11).
        min_points: masks of fewer points are ignored.
    """

    visible: float = 0.3
    contained: float = 0.8
    split: float = 0.5
    consensus: float = 0.9
    min_points: int = 4
