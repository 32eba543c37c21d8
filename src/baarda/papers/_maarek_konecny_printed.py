"""What Maarek & Konecny print: counts, tables and test values, as they stand in the paper."""

from __future__ import annotations

import numpy as np

NAN = float("nan")  # a cell that the paper leaves empty; never handed on as a number

# ---- V, the residuals of the grid measurements (Table 1); classes 4 um wide, from the top class downwards ----
V_LIMITS = np.arange(-24.0, 25.0, 4.0)
V_COUNTS = np.array([3, 5, 20, 59, 94, 149, 142, 88, 40, 18, 7, 4], dtype=float)  # from -24 upwards; one more value above 24
V_TOTAL, V_ABOVE = 630, 1
V_MEAN, V_SD_REDUNDANCY, V_SD_SAMPLE = -0.333, 7.92, 7.19
V_MEAN_MINIMUM, V_SD_MINIMUM = -0.270, 7.28
V_REDUNDANCY = 10 * 12 + 9 * 44
V_LOWER = (24, 20, 16, 12, 8, 4, 0, -4, -8, -12, -16, -20, -24)
V_Z = (3.0702, 2.5644, 2.0608, 1.5561, 1.0514, 0.5467, 0.0420, -0.4627, -0.9674, -1.4721, -1.9768, -2.4815, -2.9862)
V_EXPECTED = {
    "normal": (2.52, 8.61, 25.60, 54.72, 91.5, 120.01, 122.59, 97.49, 60.57, 33.71, 11.63, 3.39),
    "lineo": (3.09, 9.13, 23.09, 49.73, 88.83, 128.95, 132.88, 96.11, 55.34, 26.57, 10.48, 3.75),
    "radico": (3.38, 9.34, 22.52, 47.34, 86.18, 131.74, 138.17, 93.85, 52.91, 25.76, 10.95, 4.56),
}

# ---- Table 2: normal with S_M; limits from 24 downwards ----
SM_Z = (3.8372, 2.8274, 2.2711, 1.7148, 1.1585, 0.6022, 0.0458, -0.5090, -1.0653, -1.6216, -2.1779, -2.7342, -3.2905)
SM_BELOW = (1.00, 0.9976, 0.9884, 0.9568, 0.8766, 0.7264, 0.5182, 0.3054, 0.1436, 0.0524, 0.0147, 0.0033, 0.000)
SM_EXPECTED = (1.51, 5.73, 19.90, 50.53, 94.62, 131.16, 134.06, 101.93, 57.54, 23.75, 7.18, 2.07)
SM_DISTANCE = (2.49, 1.27, 1.90, 11.53, 6.62, 10.84, 14.94, 7.93, 2.54, 3.75, 2.18, 0.93)
SM_TERMS = (4.106, 0.281, 0.181, 2.631, 0.463, 0.896, 1.665, 0.617, 0.112, 0.592, 0.662, 0.418)

# ---- Table 3: normal on residuals divided by their own standard deviations; from the top class downwards ----
QV_LIMITS = np.arange(-3.0, 3.25, 0.5)
QV_COUNTS = np.array([4, 9, 20, 63, 98, 136, 121, 84, 54, 25, 8, 8], dtype=float)  # from -3 upwards
QV_BELOW = (0.9986, 0.9938, 0.9772, 0.9332, 0.8413, 0.6915, 0.5000, 0.3085, 0.1587, 0.0668, 0.0228, 0.0062, 0.0014)
QV_EXPECTED = (3.19, 10.44, 27.67, 57.81, 94.22, 120.45, 120.45, 94.22, 57.81, 27.67, 10.44, 3.19)
QV_DISTANCE = (3.71, 2.44, 2.67, 3.81, 10.22, 0.55, 15.55, 3.78, 5.29, 7.67, 1.44, 0.71)
QV_TERMS = (6.95, 0.56, 0.25, 0.25, 1.11, 0.00, 2.00, 0.15, 0.48, 2.12, 0.19, 0.15)

# ---- Table 4 ----
V_CHI2 = {"lineo": 12.01, "radico": 10.36, "normal S_o": 22.84, "normal S_M": 14.62, "normal Q_v": 14.19, "normal S_P": 14.40}
V_CRITICAL = 16.92

# ---- U, the residuals of the image coordinates (Table 5); classes by their lower limit, |limit| from 0 outwards ----
U_LIMITS = np.array([0.0, 1.75, 3.5, 5.25, 7.0, 8.75, 10.5, 12.25, 14.0, 17.5, 21.0])
U_POSITIVE = np.array([44, 36, 24, 13, 12, 3, 4, 4, 4, 2], dtype=float)
U_NEGATIVE = np.array([49, 37, 24, 12, 14, 4, 3, 4, 2, 3], dtype=float)
U_MIDS = np.array([0.88, 2.63, 4.38, 6.13, 7.88, 9.63, 11.38, 13.13, 15.75, 19.25])
U_TOTAL, U_MEAN, U_SD, U_SQUARES = 298, -0.006, 5.92, 10436.0
U_Z = (0.0000, 0.2956, 0.5912, 0.8868, 1.1824, 1.4780, 1.7360, 2.0692, 2.3658, 2.9560, 3.5928)
U_EXPECTED = {
    "normal": (34.71, 31.64, 26.61, 20.56, 14.60, 8.52, 6.49, 3.39, 2.18, NAN),
    "lineo": (37.37, 32.67, 25.98, 19.20, 13.22, 8.66, 4.08, 3.11, 2.31, 0.63),
    "radico": (39.24, 32.83, 25.32, 18.39, 12.63, 8.27, 4.60, 3.13, 2.46, 0.75),
}

# ---- Table 6: by degrees of freedom ----
U_CHI2 = {
    13: {"normal": 26.36, "lineo": 20.15, "radico": 17.05},
    15: {"normal": 32.55, "lineo": 22.06, "radico": 17.49},
    17: {"lineo": 26.80, "radico": 20.49},
}
U_CRITICAL = {13: 22.36, 15: 25.00, 17: 27.59}

# ---- Appendix 1: standard deviations of the sets (um), degrees of freedom of each, and what is printed of the test ----
SETS = {
    "9 points": ((8, 7, 10, 9, 10, 9, 11, 8, 7, 9), 12, 81.1, 2.84, 16.92),
    "25 points": ((9, 8, 9, 7, 8, 8, 7, 8, 9), 44, 66.3, 2.84, 15.151),
}

# ---- the text: peak of the modulated curves over that of the normal ----
PEAKS = {"radico": 1.16, "lineo": 1.09}
