"""Columns of the arrays that kernels pass to each other.

prepared   [17 lane] float32: values that do not depend on the view; padded to a multiple of 16 with Gaussians that are
           not drawn
records    [gaussian 16] float32: the visible Gaussians of one view, packed front to back, one cache line each
gradients  [row 16] float32: sums over the pixels of one band of a view, for each Gaussian that reaches a pixel;
           row 0 is zero
places     [lane] int32: the row of each Gaussian of the scene in `gradients`; 0 if it reaches no pixel
camera     [20] float64

With d = pixel - centre, the exponent of a Gaussian is sigma = ln(2) * (u^2 + v^2), where u = U * (d_x - SHEAR * d_y)
and v = V * d_y (the Cholesky factors of the inverse covariance). This sum of squares cannot turn negative by
rounding, and row bounds follow from it directly. Alpha is then 2^(LOG2_OPACITY - u^2 - v^2).
"""

# prepared
MEAN = 0  # 3
ROOT = 3  # 9, row-major: R(quaternion) diag(scales), whose square is the covariance
LOG2_OPACITY_AND_COLOR = 12  # 4, as in the records
REACH = 16  # the largest u^2 + v^2 at which alpha >= min_alpha; negative if the Gaussian is not drawn
PREPARED_WIDTH = 17

# records
CENTER_X = 0
CENTER_Y = 1
U = 2
SHEAR = 3
V = 4
LOG2_OPACITY = 5
RED = 6
GREEN = 7
BLUE = 8
DEPTH = 9
INVERSE_U = 10
RIGHTMOST_Y = 11  # d_y of the ellipse's right-most point; its left-most is at minus this
EXTENT_Y = 12  # half the ellipse's height
ROWS = 13  # as int32: first block row, and the last one shifted up by 16 bits
INDEX = 14  # as int32: the Gaussian's row in the scene
RECORD_WIDTH = 16

# gradients
SUM_COLOR = 0  # 3 columns; sums of weight times the gradient of a colour channel
SUM_DEPTH = 3
SUM_S = 4  # s is -dL/dsigma at a pixel
SUM_SU = 5
SUM_SV = 6
SUM_SUU = 7
SUM_SUV = 8
SUM_SVV = 9
REACHED = 10  # 1 except in row 0
GRADIENT_WIDTH = 16

# camera
ROTATION = 0  # 9 columns, row-major
TRANSLATION = 9
FOCAL_X = 12
FOCAL_Y = 13
PRINCIPAL_X = 14
PRINCIPAL_Y = 15
MIN_SLOPE_X = 16
MAX_SLOPE_X = 17
MIN_SLOPE_Y = 18
MAX_SLOPE_Y = 19  # limits of x/z and y/z in the Jacobian
CAMERA_WIDTH = 20

# images are processed in blocks of 4 x 4 pixels, row-major, with one SIMD lane for each pixel
BLOCK = 4
BLOCK_SHIFT = 2

# A Gaussian's blocks are chosen with the threshold of alpha times 2^-SLACK (1e-4 below it), so that rounding in this
# choice loses no pixel. The test at each pixel uses the threshold itself.
SLACK = 1.5e-4
