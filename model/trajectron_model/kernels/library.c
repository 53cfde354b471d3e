/* What the library is: compared by the loader before it is used. */
#include "simd.h"

KERNEL const char *trajectron_fingerprint(void) { return TRAJECTRON_FINGERPRINT; }
KERNEL int trajectron_lanes(void) { return LANES; }
KERNEL int trajectron_tile_rows(void) { return TILE_ROWS; }
