// every 16 entries: which parts, two a row, still see something, a bit each
if (((e - begin) & 15) == 15)
{
    for (int part = 0; part < 32; ++part)
        if ((alive >> part & 1u) && !__builtin_reduce_or(left[part >> 1][part & 1] > stop))
            alive &= ~(1u << part);
}
