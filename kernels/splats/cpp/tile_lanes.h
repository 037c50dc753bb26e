// eight pixels at once
typedef float lanes __attribute__((ext_vector_type(8)));
typedef int bits __attribute__((ext_vector_type(8)));
typedef bool flags __attribute__((ext_vector_type(8)));
const lanes steps = {0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f};
const float least = -7.994353437f;
const auto lane_bits = [](bits found)
{
    const flags set = __builtin_convertvector(found, flags);
    unsigned char byte;
    __builtin_memcpy(&byte, &set, 1);
    return (unsigned)byte;
};
