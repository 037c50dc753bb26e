const int width = sh.shape[1];
#if defined(__CUDA_ARCH__)
#include "own_row.h"
if (whole)
{
    const float* c = own;
    const int width = 24;
#include "color_of_row.h"
    return wp::vec_t<3, wp::float32>(red, green, blue);
}
#include "staged_rows.h"
const float* c = rows + lane * stride;
#else
const float* c = sh.data + (size_t)row * width;
#endif
#include "color_of_row.h"
return wp::vec_t<3, wp::float32>(red, green, blue);
