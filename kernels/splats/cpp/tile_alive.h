// every 16 entries: which parts, eight pixels each, still see something; bit y of those on the left, 16 + y on the right
if (((e - begin) & 15) == 0)
    for (unsigned rest = alive; rest; rest &= rest - 1u)
    {
        const int bit = __builtin_ctz(rest);
        if (!__builtin_reduce_or(left[bit & 15][bit >> 4] > stop))
            alive &= ~(1u << bit);
    }
