// color = numbers . basis of a row c of `width` numbers
float red = 0.0f, green = 0.0f, blue = 0.0f;
if (width == 24)
{
    float y = 0.0f, orange = 0.0f;
    for (int b = 0; b < 16; ++b)
        y += basis.c[b] * c[b];
    for (int b = 0; b < 4; ++b)
    {
        orange += basis.c[b] * c[16 + b];
        green += basis.c[b] * c[20 + b];
    }
    red = y + orange - 0.5f * green;
    blue = y - orange - 0.5f * green;
    green += y;
}
else
{
    for (int b = 0; b < 9; ++b)
    {
        red += basis.c[b] * c[b];
        green += basis.c[b] * c[9 + b];
        blue += basis.c[b] * c[18 + b];
    }
}
