"""What a calibration board is: its points, its print, its definition in a file."""

from calibration.boards.board import Board
from calibration.boards.charuco import Charuco
from calibration.boards.chessboard import Chessboard
from calibration.boards.circles import AsymmetricCircles, Circles
from calibration.boards.loading import AnyBoard, board_from, load_board

__all__ = ["AnyBoard", "AsymmetricCircles", "Board", "Charuco", "Chessboard", "Circles", "board_from", "load_board"]
