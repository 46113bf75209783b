"""Find a calibration board in a picture: its points to a hundredth of a pixel, or the reason why it is not there.

The order of the points is the same in all pictures of a board as far as its pattern allows, and never that of a mirror
image. What a pattern cannot tell is settled by the picture: of the `symmetry` orders that look the same, the one whose
rows point most to the right. For one camera that does no harm, since a turned order is the same board in another pose;
for several cameras that see one board at once it does as soon as one of them is rolled by more than 90 deg against the
others, so take a board of symmetry 1 there. That a picture is mirrored can be seen on ChArUco boards and on asymmetric
grids with an even number of rows; chessboards and other grids are their own mirror images.
"""

from __future__ import annotations

import numpy as np

from calibration.boards.board_types import Board, Charuco, Chessboard
from calibration.boards.board_view import NO_CLOSE_LOOK, BoardView, GreyImage, NotFound
from calibration.boards.charuco_detection import find_charuco
from calibration.boards.chessboard_detection import find_chessboard
from calibration.boards.circle_detection import find_circles

__all__ = ["NO_CLOSE_LOOK", "BoardView", "NotFound", "find_board"]


def find_board(image: GreyImage, board: Board, closely: bool = True) -> BoardView | NotFound:
    """The board in a grey picture (h, w) of 8 bits. Raises ValueError for another kind of picture.

    closely: else only the quick ways are tried, and no cause is looked for (NO_CLOSE_LOOK): of 1280x1024 pixels without
    the board a close look takes 2 to 5 s, a quick one 0.02 to 0.3 s.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"expected a grey picture (h, w) of 8 bits, got {image.shape} of {image.dtype}")
    if min(image.shape) < 32:
        return NotFound(f"the picture is only {image.shape[1]}x{image.shape[0]} pixels")
    image = np.ascontiguousarray(image)
    if isinstance(board, Chessboard):
        return find_chessboard(image, board, closely)
    if isinstance(board, Charuco):
        return find_charuco(image, board, closely)
    return find_circles(image, board, closely)
