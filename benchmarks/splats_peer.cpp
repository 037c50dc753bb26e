// Binds the forward kernels of gsplat 1.5.3 that draw 3D Gaussians with three channels; see splats_peer.py.
#include <torch/extension.h>
#include "Common.h"
#include "Ops.h"
#include "Projection.h"
#include "Rasterization.h"

using at::Tensor;

std::vector<Tensor> project(Tensor means, Tensor covars, Tensor opacities, Tensor viewmats, Tensor Ks, int64_t w,
                            int64_t h, double eps, double near, bool compensate) {
    auto opt = means.options();
    int64_t n = means.size(0), c = viewmats.size(0);
    Tensor radii = at::empty({c, n, 2}, opt.dtype(at::kInt)), means2d = at::empty({c, n, 2}, opt);
    Tensor depths = at::empty({c, n}, opt), conics = at::empty({c, n, 3}, opt), comp = at::zeros({c, n}, opt);
    gsplat::launch_projection_ewa_3dgs_fused_fwd_kernel(
        means, covars, at::optional<Tensor>(), at::optional<Tensor>(), opacities, viewmats, Ks, w, h, eps, near, 1e10,
        0.0, gsplat::CameraModelType::PINHOLE, radii, means2d, depths, conics,
        compensate ? at::optional<Tensor>(comp) : at::optional<Tensor>());
    return {radii, means2d, depths, conics, comp};
}

std::vector<Tensor> rasterize(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor backgrounds,
                              int64_t w, int64_t h, int64_t tile, Tensor offsets, Tensor ids) {
    auto opt = means2d.options();
    int64_t c = offsets.size(0);
    Tensor out = at::empty({c, h, w, 3}, opt), alpha = at::empty({c, h, w, 1}, opt);
    Tensor last = at::empty({c, h, w}, opt.dtype(at::kInt));
    gsplat::launch_rasterize_to_pixels_3dgs_fwd_kernel<3>(means2d, conics, colors, opacities, backgrounds,
                                                          at::optional<Tensor>(), w, h, tile, offsets, ids, out, alpha,
                                                          last);
    return {out, alpha};
}

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
    m.def("project", &project);
    m.def("rasterize", &rasterize);
    m.def("intersect_tile", [](Tensor means2d, Tensor radii, Tensor depths, int64_t tile, int64_t tw, int64_t th) {
        return gsplat::intersect_tile(means2d, radii, depths, at::optional<Tensor>(), at::optional<Tensor>(),
                                      radii.size(0), tile, tw, th, true, false);
    });
    m.def("intersect_offset", [](Tensor ids, int64_t c, int64_t tw, int64_t th) {
        return gsplat::intersect_offset(ids, c, tw, th);
    });
    m.def("harmonics", [](int64_t degree, Tensor dirs, Tensor coeffs, Tensor mask) {
        return gsplat::spherical_harmonics_fwd(degree, dirs, coeffs, at::optional<Tensor>(mask));
    });
}
