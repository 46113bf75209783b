"""Detection of a calibration board in a picture: its points to a hundredth of a pixel, or the reason for a failure.

The points are in the same order in all pictures of a board as far as its pattern determines it, and never in that of a
mirror image. Of the `symmetry` equivalent orders, the one whose rows point most to the right is taken. This is harmless
for one camera, since a turned order is the same board in another pose. It is not for several cameras that see one board
at once, if one of them is rolled by more than 90 deg against the others: use a board of symmetry 1 there. Mirrored
pictures are detected with ChArUco boards and with asymmetric grids that have an even number of rows; chessboards and
other grids are their own mirror images.
"""

from __future__ import annotations

import numpy as np

from calibration.boards.board_types import Board, Charuco, Chessboard
from calibration.boards.board_view import BoardView, GreyImage, NotFound
from calibration.boards.charuco_detection import find_charuco
from calibration.boards.chessboard_detection import find_chessboard
from calibration.boards.circle_detection import find_circles


def find_board(image: GreyImage, board: Board, thorough: bool = True) -> BoardView | NotFound:
    """The board in a grey picture (h, w) of 8 bits.

    thorough: if False, only the fast methods are used, and the reason for a failure is not determined
    (QUICK_SEARCH_FAILED). For 1280x1024 pixels without a board, a thorough search takes 2 to 5 s, a quick one 0.02 to
    0.3 s. Raises ValueError: the picture has another type.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"expected a grey picture (h, w) of 8 bits, got {image.shape} of {image.dtype}")
    if min(image.shape) < 32:
        return NotFound(f"the picture is only {image.shape[1]}x{image.shape[0]} pixels")
    image = np.ascontiguousarray(image)
    if isinstance(board, Chessboard):
        return find_chessboard(image, board, thorough)
    if isinstance(board, Charuco):
        return find_charuco(image, board, thorough)
    return find_circles(image, board, thorough)
