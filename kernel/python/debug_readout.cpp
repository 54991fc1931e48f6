// All intermediate values of the last step, for tests: the prepared model and scene, the kinematics, the motion bounds,
// the rows, and the pairs for the certificate.
#include <cstring>
#include <string>
#include <vector>

#include "kernel.h"

extern "C" {
#include "distance/dbk_broadphase.h"
}

namespace {

// the whole array of a field, including its unused entries, as the bytes of float64 numbers
template <typename T, typename U>
void put(nb::dict &d, const char *name, const U &field) {
  const auto *from = reinterpret_cast<const T *>(&field);
  std::vector<double> all(from, from + sizeof field / sizeof(T));
  d[name] = nb::bytes(reinterpret_cast<const char *>(all.data()), all.size() * sizeof(double));
}

#define REALS(where, field) put<dbk_real>(d, #field, (where).field)
#define INTEGERS(where, field) put<int32_t>(d, #field, (where).field)

nb::dict model_fields(const dbk_model &m) {
  nb::dict d;
  REALS(m, reach);
  REALS(m, link_reach);
  REALS(m, bounding_sphere);
  REALS(m, scale);
  INTEGERS(m, sphere_frame);
  return d;
}

nb::dict scene_fields(const dbk_scene &s) {
  nb::dict d;
  const dbk_obstacle_capsules &c = s.capsules;
  REALS(c, x), REALS(c, y), REALS(c, z), REALS(c, ax), REALS(c, ay), REALS(c, az), REALS(c, half), REALS(c, radius);
  REALS(c, margin), REALS(c, alpha), REALS(c, vx), REALS(c, vy), REALS(c, vz), REALS(c, velocity_error),
      REALS(c, max_speed);
  put<uint32_t>(d, "link_mask", c.link_mask);
  INTEGERS(c, known), INTEGERS(c, moving), INTEGERS(c, rank), INTEGERS(c, plain), INTEGERS(c, any_half_space);
  INTEGERS(c, any_separation), INTEGERS(s, ready), INTEGERS(s, n_obstacles), REALS(s, permit),
      REALS(s, held_bounding_sphere);
  REALS(s, held_error), INTEGERS(s, n_held), INTEGERS(s, n_user);
  put<int32_t>(d, "any_moving", s.moving);
  return d;
}

nb::dict motion_fields(const dbk_sphere_motion &m) {
  nb::dict d;
  REALS(m, vx), REALS(m, vy), REALS(m, vz), REALS(m, ax), REALS(m, ay), REALS(m, az), REALS(m, spread);
  REALS(m, joint_max_speed), REALS(m, joint_half_width), REALS(m, joint_excess), REALS(m, chain);
  REALS(m, bound_x), REALS(m, bound_y), REALS(m, bound_z), REALS(m, bound_r);
  REALS(m, inner_distance), REALS(m, centres_radius);
  REALS(m, trust_speed), REALS(m, max_speed), REALS(m, sampling_term);
  return d;
}

nb::dict row_fields(const dbk_rows &r) {
  nb::dict d;
  REALS(r, a), REALS(r, b), REALS(r, h), REALS(r, norm), REALS(r, soft);
  INTEGERS(r, count), INTEGERS(r, kind), INTEGERS(r, i), INTEGERS(r, j), INTEGERS(r, clip), INTEGERS(r, moving),
      INTEGERS(r, rank);
  INTEGERS(r, overflow), INTEGERS(r, no_gradient), INTEGERS(r, unavoidable);
  INTEGERS(r, n_spans), INTEGERS(r, span_first), INTEGERS(r, span_first_joint), INTEGERS(r, span_end_joint);
  INTEGERS(r, span_many_spheres);
  return d;
}

nb::dict step_fields(const dbk_ctx &c) {
  nb::dict d;
  REALS(c, u_prev), REALS(c, u_nom_prev), REALS(c, u_change), REALS(c, lower), REALS(c, upper), REALS(c, h_min);
  REALS(c, trust_lower), REALS(c, trust_upper), INTEGERS(c, trust_active), INTEGERS(c, n_warm), INTEGERS(c, warm);
  put<dbk_real>(d, "rotation", c.frames.rotation);
  put<dbk_real>(d, "origin", c.frames.origin);
  put<int32_t>(d, "n_spheres", c.spheres.count);
  put<dbk_real>(d, "x", c.spheres.x);
  put<dbk_real>(d, "y", c.spheres.y);
  put<dbk_real>(d, "z", c.spheres.z);
  put<dbk_real>(d, "r", c.spheres.r);
  put<int32_t>(d, "revisits", c.revisits.count);
  INTEGERS(c, narrow_phase_count);
  put<int16_t>(d, "revisit_first", c.revisits.first_sphere);
  put<int16_t>(d, "revisit_spheres", c.revisits.n_spheres);
  put<int16_t>(d, "revisit_other", c.revisits.other);
  return d;
}

// the predicted obstacles, and the relevant ones of every link with the motion bounds of the last step
nb::dict broadphase_fields(const dbk_model &model, const dbk_scene &scene, const dbk_ctx &ctx, dbk_real age,
                           dbk_real extra, bool known_only) {
  nb::dict d;
  std::unique_ptr<dbk_predicted_obstacles> predicted{new dbk_predicted_obstacles()};
  std::unique_ptr<dbk_candidates> candidates{new dbk_candidates()};
  dbk_predict_obstacles(&model, &scene, age, extra, known_only, predicted.get());
  dbk_broadphase(&model, &scene, &ctx, predicted.get(), candidates.get());
  REALS(*predicted, x), REALS(*predicted, y), REALS(*predicted, z), REALS(*predicted, margin), REALS(*predicted, alpha);
  put<uint32_t>(d, "link_mask", predicted->link_mask);
  INTEGERS(*candidates, count);
  put<int16_t>(d, "index", candidates->index);
  return d;
}

}  // namespace

nb::dict Kernel::debug_readout(double extra, bool known_only) const {
  nb::dict d;
  d["model"] = model_fields(*used_model);
  d["scene"] = scene_fields(*scene);
  d["motion"] = motion_fields(ctx->motion);
  d["rows"] = row_fields(ctx->rows);
  d["step"] = step_fields(*ctx);
  if (scene->n_obstacles > 0) {
    d["broadphase"] = broadphase_fields(*used_model, *scene, *ctx, in.scene_age, static_cast<dbk_real>(extra), known_only);
  }
  return d;
}

void Kernel::fill_memory(int byte) {
  std::memset(ctx.get(), byte, sizeof *ctx);
  std::memset(projection_ctx.get(), byte, sizeof *projection_ctx);
  dbk_init(ctx.get());
  dbk_init(projection_ctx.get());
}
