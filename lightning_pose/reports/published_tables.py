"""Figures of published tables, cell by cell: median error in metres / degrees on the official test split.

The tables of A. Elmoogy, "Efficient Image Based Localization Using Machine Learning Techniques" (University of
Victoria), and means that the field quotes. Cells are as printed, but for three kinds of slips that the chapters
themselves give away:

- Tables 2.3 and 3.2 name the scenes in another order than the later ones, yet seven of their rows from the literature
  are in the later order (there, and in table 6.1, each cell has its scene). These rows are read in that order.
- Table 4.1's "0.8/47" is 0.8/4.7.
- Table 3.2's ".25/12.00" is 0.25/12.00.

Averages are not kept: several do not equal the mean of their rows, so means are computed anew.
"""

from __future__ import annotations

__all__ = ["FRAMES", "MEANS", "REMARKS", "SCENES", "TABLES"]

SCENES = {
    "chess": "chess",
    "fire": "fire",
    "heads": "heads",
    "office": "office",
    "pumpkin": "pumpkin",
    "redkitchen": "kitchen",
    "stairs": "stairs",
    "kingscollege": "kings",
    "stmaryschurch": "mary",
    "shopfacade": "shop",
}
"""Names of the datasets' folders, in small letters without spaces, hyphens and underscores, to the names below."""

FRAMES = {
    "chess": 2000, "fire": 2000, "heads": 1000, "office": 4000, "pumpkin": 2000, "kitchen": 5000, "stairs": 1000,
    "kings": 343, "mary": 530, "shop": 103,
}  # fmt: skip
"""Test frames of the official splits."""

CHAPTER_2 = "chess office pumpkin kitchen stairs heads fire"
LATER = "chess fire heads office pumpkin kitchen stairs"
CAMBRIDGE = f"{LATER} kings mary shop"
CHAPTER_6 = "heads chess fire office kitchen pumpkin stairs"

_LITERATURE_2 = """
PoseNet         0.32/8.12 0.47/14.4 0.29/12.0 0.48/8.42 0.47/8.42 0.59/8.64 0.47/13.8
Posenet-U       0.37/7.24 0.43/13.7 0.31/12.0 0.48/8.04 0.61/7.08 0.58/7.54 0.48/13.1
G-PoseNet       0.20/7.11 0.38/12.3 0.21/13.8 0.28/8.83 0.37/6.94 0.35/8.15 0.37/12.5
Pose-L          0.24/5.77 0.34/11.9 0.21/13.7 0.30/8.08 0.33/7.00 0.37/8.83 0.40/13.7
Mobile-PoseNet  0.19/8.22 0.37/13.2 0.18/15.5 0.27/8.54 0.34/8.46 0.31/8.05 0.45/13.6
"""

_BRANCHNET = "BranchNet  0.18/5.17 0.30/7.05 0.27/5.10 0.33/7.40 0.38/10.30 0.20/14.2 0.34/8.99"

_LITERATURE_4 = """
SURF-CNN        0.19/8.10 0.24/12.8 0.17/12 0.35/9 0.36/10.8 0.39/10.2 0.36/10.8 7.66/12.3 4.5/10.5 3.2/9.2
SURF-LSTM       0.22/7.04 0.24/10.2 0.16/13.6 0.35/8.5 0.35/7.8 0.38/9.5 0.35/11.9 5.53/10.6 3.2/9.2 1.46/8.1
PoseNet         0.32/8.12 0.47/14.4 0.29/12.0 0.48/8.42 0.47/8.42 0.59/8.64 0.47/13.8 1.92/5.40 1.46/8.1 1.11/7.6
Dense VLAD      0.21/12.5 0.33/13.8 0.15/14.9 0.28/11.2 0.31/11.3 0.30/12.3 0.25/15.8 2.80/5.75 1.11/7.6 1.25/7.5
Bay. PN         0.37/7.24 0.43/13.7 0.31/12.0 0.48/8.04 0.61/7.08 0.58/7.54 0.48/13.1 1.74/4.06 1.25/7.5 1.79/6.5
PN L-W          0.14/4.50 0.27/11.8 0.18/12.1 0.20/5.77 0.25/4.84 0.24/5.52 0.37/10.6 0.99/1.06 1.05/3.9 1.18/7.4
Mobile-PoseNet  0.19/8.22 0.37/13.2 0.18/15.5 0.27/8.54 0.34/8.46 0.31/8.05 0.45/13.6 1.14/1.53 2.18/6.1 1.73/6.19
Vidloc          0.16 0.21 0.14 0.24 0.36 0.31 0.26 - - -
"""

TABLES: tuple[tuple[str, str, str], ...] = (
    ("2.3", CHAPTER_2, f"""
SurfCNN 300     0.19/8.10 0.35/7.05 0.36/10.80 0.37/10.25 0.28/10.14 0.17/12 0.24/8.20
SurfCNN 100     0.23/10.20 0.38/9.50 0.38/9.52 0.45/12.35 0.32/11.25 0.19/12.50 0.26/9.25
SurfCNN 50      0.26/10.50 0.42/10.31 0.39/13.20 0.47/13.20 0.34/12.22 0.21/13 0.28/10.52
SurfCNN 10      0.29/11.15 0.47/11.65 0.41/15.11 0.53/14.10 0.45/12.52 0.25/14 0.29/11.20
SurfCNN 1       0.31/11.57 0.5/12.10 0.42/17 0.56/16.52 0.53/13.20 0.26/18.19 0.26/18.19
{_BRANCHNET}
RelocNet        0.21/10.9 0.31/10.3 0.40/10.9 0.33/10.3 0.33/11.4 0.15/13.4 0.32/11.8
"""),
    ("2.3", LATER, f"""{_LITERATURE_2}
Pose-H          0.15/6.17 0.27/10.8 0.19/11.6 0.21/8.48 0.25/7.01 0.27/10.2 0.29/12.5
VidLoc          0.16 0.21 0.14 0.24 0.36 0.31 0.26
"""),
    ("3.2", CHAPTER_2, f"""
SURF-LSTM 300   0.22/7.89 0.32/7.14 0.41/9.97 0.38/7.62 0.36/10.12 0.17/12.15 0.22/11.87
SURF-LSTM 100   0.21/7.87 0.31/7.04 0.40/9.99 0.36/7.64 0.36/10.15 0.17/12.19 0.23/11.85
SURF-LSTM 50    0.21/7.98 0.32/7.05 0.40/9.94 0.36/7.60 0.35/10.10 0.16/12.1 0.22/11.87
SURF-LSTM 40    0.22/8.05 0.32/7.00 0.38/9.45 0.36/8.94 0.37/11.45 0.18/12.85 0.22/11.85
SURF-LSTM 30    0.21/8.00 0.37/7.50 0.35/7.93 0.43/9.84 0.38/12.49 0.20/13.45 0.25/12.00
SURF-LSTM 20    0.208/7.74 0.40/8.53 0.37/10.75 0.48/10.74 0.42/13.56 0.24/14.34 0.26/12.45
SURF-LSTM 10    0.26/9.09 0.42/9.50 0.38/11.93 0.55/11.98 0.44/13.94 0.26/15.56 0.29/13.94
{_BRANCHNET}
SurfCNN         0.19/8.10 0.35/7.05 0.36/10.80 0.37/10.25 0.28/10.14 0.17/12 0.24/12.80
"""),
    ("3.2", LATER, _LITERATURE_2),
    ("4.1", CAMBRIDGE, f"""
Node-Pose (ImageNet)   0.12/6 0.20/8.4 0.11/11.1 0.20/6.8 0.20/5.5 0.27/7.5 0.22/7.2 1.8/3.5 2/5.5 0.8/4.7
Node-Pose (Places)     0.16/8 0.25/9.4 0.15/11.8 0.25/8.1 0.23/6.5 0.32/9.5 0.28/9.2 1.4/2.8 1.7/5 0.6/3.57
Graph-Pose (ImageNet)  0.14/6.4 0.23/8.6 0.15/11.8 0.23/6.8 0.23/5.5 0.32/7.7 0.24/7.4 2.3/4.6 2.5/6.9 1.1/5.1
Graph-Pose (Places)    0.18/8.1 0.25/8.8 0.15/11.9 0.26/8.9 0.26/5.5 0.34/10 0.27/9.47 1.6/3.1 1.9/5.5 0.8/4
G-PoseNet  0.24/5.77 0.34/11.9 0.21/13.7 0.30/8.08 0.33/7.00 0.37/8.83 0.40/13.7 0.88/1.04 1.18/7.4 1.14/5.7
Pose-Hourglass  0.15/6.17 0.27/10.8 0.19/11.6 0.21/8.48 0.25/7.01 0.27/10.2 0.29/12.5 0.99/3.65 1.14/5.7 3.2/9.2
{_LITERATURE_4}
"""),
    ("5.2", CAMBRIDGE, f"""
Linear-PoseNet (ImageNet)  0.18/8.3 0.28/11.5 0.15/12 0.26/10 0.26/8 0.39/12.8 0.42/7.35 5.7/6.15 7.8/18 2.5/11
Linear-PoseNet (Places)    0.2/8.3 0.29/13 0.16/11.5 0.27/10 0.28/8.5 0.4/13 0.56/11 4.7/4.8 6/14 2.4/9.8
Dense-PoseNet (ImageNet)   0.13/4.5 0.22/9.5 0.11/11.5 0.21/8.5 0.23/6.5 0.24/8.5 0.24/10 1.7/3.5 2/6.5 0.9/4
Dense-PoseNet (Places)     0.15/6.9 0.25/8.5 0.15/13 0.28/9.3 0.26/7.5 0.26/9.5 0.27/12 1.5/2.9 1.7/6.3 0.75/3.5
LSTM. PN   0.24/5.77 0.34/11.9 0.21/13.7 0.30/8.08 0.33/7.00 0.37/8.83 0.40/13.7 0.88/1.04 1.18/7.4 1.14/5.7
G-PoseNet  0.20/7.11 0.38/12.3 0.21/13.8 0.28/8.83 0.37/6.94 0.35/8.15 0.37/12.5 0.99/3.65 1.14/5.7 3.2/9.2
Pose-Hourglass  0.15/6.17 0.27/10.8 0.19/11.6 0.21/8.48 0.25/7.01 0.27/10.2 0.29/12.5 - - -
{_LITERATURE_4}
"""),
    ("6.1", CHAPTER_6, """
VidLoc          0.14 0.18 0.26 0.26 0.31 0.36 0.26
PoseNet         0.29/12 0.32/8.12 0.47/14.4 0.48/7.68 0.59/8.64 0.47/8.42 0.47/13.8
Pose-LSTM       0.21/13.7 0.24/5.77 0.34/11.9 0.30/8.08 0.37/8.83 0.37/7.00 0.40/13.7
Pose-Hourglass  0.15/6.53 0.15/6.53 0.27/10.84 0.21/8.48 0.27/10.15 0.27/7.01 0.29/12.46
NNET            0.13/6.46 0.26/12.72 0.14/12.34 0.21/7.35 0.24/6.35 0.24/8.03 0.27/11.82
2D CNN-RNN, clips  0.187/7.26 0.22/8.00 0.195/9.89 0.25/10.05 0.211/7.5 0.22/7.26 0.197/7.67
3D CNN, clips      0.148/6.25 0.16/7.28 0.156/7.00 0.201/9.02 0.16/6.5 0.155/8.05 0.15/6.3
"""),
)  # fmt: skip
"""Table, the order of its scenes, and its rows. Rows whose name ends with `clips` have relative poses over videos."""

MEANS: tuple[tuple[str, str, str], ...] = (
    ("DenseVLAD", "Sattler 2019", "0.26/13.1"),
    ("PoseNet", "Kendall 2015", "0.44/10.4"),
    ("PoseNet, learned weights", "Kendall 2017", "0.24/7.87"),
    ("MapNet", "Brahmbhatt 2018", "0.21/7.78"),
    ("AtLoc", "Wang 2020", "0.20/7.56"),
    ("MS-Transformer", "Shavit 2021", "0.18/7.28"),
    ("constant pose", "reference", "0.80/32"),
    ("oracle retrieval", "reference", "0.18/14.2"),
)
"""System, where from, and the mean over the seven scenes, as published (original ground truth, official splits)."""

REMARKS = {
    "2.3": "the rows PoseNet, Posenet-U, G-PoseNet, Pose-L, Pose-H, VidLoc and Mobile-PoseNet of table 2.3 are read "
    "in the order of scenes of tables 4.1 and 5.2, which its heading does not have",
    "3.2": "the rows PoseNet, Posenet-U, G-PoseNet, Pose-L and Mobile-PoseNet of table 3.2 likewise",
    "4.1": "table 4.1 gives G-PoseNet the cells that table 5.2 gives LSTM. PN",
    "shop": "table 4.1's shop cell of Node-Pose (ImageNet), 0.8/47, is taken for 0.8/4.7",
    "mary": "in tables 4.1 and 5.2, most cells of St Mary's below the chapter's own systems repeat the shop's of the "
    "row above: as printed, but not to be relied on",
    "6.1": "the clips of table 6.1 have 2 to 400 frames, of scenes that were not trained on",
}
"""What a reader of a table must know, by table, or by scene of tables 4.1 and 5.2."""
