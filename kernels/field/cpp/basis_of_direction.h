// `values` of sh_basis at x, y, z; nine where rows have 27 numbers, which lie between zeros
const float xx = x * x, yy = y * y, zz = z * z;
values[0] = 0.28209479177387814f;
values[1] = -0.4886025119029199f * y;
values[2] = 0.4886025119029199f * z;
values[3] = -0.4886025119029199f * x;
values[4] = 1.0925484305920792f * x * y;
values[5] = -1.0925484305920792f * y * z;
values[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
values[7] = -1.0925484305920792f * x * z;
values[8] = 0.5462742152960396f * (xx - yy);
if (width == 24)
{
    values[9] = -0.5900435899266435f * y * (3.0f * xx - yy);
    values[10] = 2.890611442640554f * x * y * z;
    values[11] = -0.4570457994644658f * y * (4.0f * zz - xx - yy);
    values[12] = 0.3731763325901154f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
    values[13] = -0.4570457994644658f * x * (4.0f * zz - xx - yy);
    values[14] = 1.445305721320277f * z * (xx - yy);
    values[15] = -0.5900435899266435f * x * (xx - 3.0f * yy);
}
