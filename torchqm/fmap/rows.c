/* Cholesky factors and solutions of many small systems that share a matrix and differ in their diagonals.
 *
 * LAPACK takes one system after the other and reaches a sixth of a core's speed at 100 rows. Here as many systems as fit
 * a vector register are factored together, one in each lane: no step of one waits for itself, and no entry is loaded
 * without being used for all of them. */

#include <float.h>
#include <math.h>

#include "../native.h"

#define TILE 4 /* entries of a TILE x TILE block stay in registers while they are summed up */

/* Numbers in a vector of float32 and of float64, and rows in a block. */
EXPORT int lanes_float(void) { return BYTES / sizeof(float); }
EXPORT int lanes_double(void) { return BYTES / sizeof(double); }
EXPORT int tile(void) { return TILE; }

#define REAL float
#define LANES (BYTES / (int)sizeof(float))
#define SQRT sqrtf
#define LARGEST FLT_MAX
#define NAME(x) x##_float
#define BODY(x) x##_float_body
#define VERSIONS_OF(x) VERSIONS(x##_float)
#include "rows_kernel.h"
#undef REAL
#undef LANES
#undef SQRT
#undef LARGEST
#undef NAME
#undef BODY
#undef VERSIONS_OF

#define REAL double
#define LANES (BYTES / (int)sizeof(double))
#define SQRT sqrt
#define LARGEST DBL_MAX
#define NAME(x) x##_double
#define BODY(x) x##_double_body
#define VERSIONS_OF(x) VERSIONS(x##_double)
#include "rows_kernel.h"
