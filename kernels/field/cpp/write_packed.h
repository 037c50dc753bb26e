#if defined(__CUDA_ARCH__)
const int width = sh.shape[1];
#include "own_row.h"
if (whole)
{
    const float* c = own;
    const bool luminous = true;
    if (target < 0)
        return;
#include "packed_row.h"
    return;
}
#include "staged_rows.h"
if (target < 0)
    return;
const float* c = rows + lane * stride;
const bool luminous = width == 24;
#include "packed_row.h"
#endif
