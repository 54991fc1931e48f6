// What a filter is made of and what its last step worked with, number by number, for the tests of its laws: what was
// prepared of the body and of the scene, where everything was, how it could move, which pairs were looked at.
#include <cstring>
#include <string>
#include <vector>

#include "kernel.h"

extern "C" {
#include "../src/dbk_pair.h"
}

namespace {

// a whole array as the bytes of float64, also what lies behind the last number in use
template <typename T, typename U>
void put(nb::dict &d, const char *name, const U &field) {
  const auto *from = reinterpret_cast<const T *>(&field);
  std::vector<double> all(from, from + sizeof field / sizeof(T));
  d[name] = nb::bytes(reinterpret_cast<const char *>(all.data()), all.size() * sizeof(double));
}

#define REAL(where, field) put<dbk_real>(d, #field, (where).field)
#define WHOLE(where, field) put<int32_t>(d, #field, (where).field)

nb::dict of_body(const dbk_model &m) {
  nb::dict d;
  REAL(m, reach);
  REAL(m, link_reach);
  REAL(m, ball);
  REAL(m, scale);
  WHOLE(m, sphere_frame);
  return d;
}

nb::dict of_scene(const dbk_scene &s) {
  nb::dict d;
  const dbk_covers &c = s.covers;
  REAL(c, x), REAL(c, y), REAL(c, z), REAL(c, ax), REAL(c, ay), REAL(c, az), REAL(c, half), REAL(c, radius);
  REAL(c, margin), REAL(c, alpha), REAL(c, vx), REAL(c, vy), REAL(c, vz), REAL(c, error), REAL(c, speed);
  put<uint32_t>(d, "parts", c.parts);
  WHOLE(c, known), WHOLE(c, moving), WHOLE(c, rank), WHOLE(c, plain), WHOLE(c, any_half_space);
  WHOLE(c, any_separation), WHOLE(s, ready), WHOLE(s, n_obstacles), REAL(s, permit), REAL(s, held_ball);
  REAL(s, held_error), WHOLE(s, n_held), WHOLE(s, n_user);
  put<int32_t>(d, "any_moving", s.moving);
  return d;
}

nb::dict of_motion(const dbk_motion &m) {
  nb::dict d;
  REAL(m, vx), REAL(m, vy), REAL(m, vz), REAL(m, ax), REAL(m, ay), REAL(m, az), REAL(m, spread);
  REAL(m, fast), REAL(m, wide), REAL(m, beyond), REAL(m, twist);
  REAL(m, bound_x), REAL(m, bound_y), REAL(m, bound_z), REAL(m, bound_r), REAL(m, inner);
  REAL(m, speed), REAL(m, haste), REAL(m, bend);
  return d;
}

nb::dict of_rows(const dbk_rows &r) {
  nb::dict d;
  REAL(r, a), REAL(r, b), REAL(r, h), REAL(r, norm), REAL(r, soft);
  WHOLE(r, count), WHOLE(r, kind), WHOLE(r, i), WHOLE(r, j), WHOLE(r, yielding), WHOLE(r, moving), WHOLE(r, rank);
  WHOLE(r, overflow), WHOLE(r, stuck), WHOLE(r, unavoidable);
  WHOLE(r, n_spans), WHOLE(r, span_first), WHOLE(r, span_from), WHOLE(r, span_upto), WHOLE(r, span_several);
  return d;
}

nb::dict of_step(const dbk_ctx &c) {
  nb::dict d;
  REAL(c, u_prev), REAL(c, u_nom_prev), REAL(c, change), REAL(c, lower), REAL(c, upper), REAL(c, h_min);
  REAL(c, trust_lower), REAL(c, trust_upper), WHOLE(c, trusted), WHOLE(c, n_warm), WHOLE(c, warm);
  put<dbk_real>(d, "rotation", c.frames.rotation);
  put<dbk_real>(d, "origin", c.frames.origin);
  put<int32_t>(d, "spheres", c.cloud.count);
  put<dbk_real>(d, "x", c.cloud.x);
  put<dbk_real>(d, "y", c.cloud.y);
  put<dbk_real>(d, "z", c.cloud.z);
  put<dbk_real>(d, "r", c.cloud.r);
  put<int32_t>(d, "visits", c.visits.count);
  WHOLE(c, glances);
  put<int16_t>(d, "visit_first", c.visits.first);
  put<int16_t>(d, "visit_spheres", c.visits.spheres);
  put<int16_t>(d, "visit_other", c.visits.other);
  return d;
}

// the obstacles moved on by their age, and those that matter for every link, as the last step's motion has it
nb::dict of_surroundings(const dbk_model &model, const dbk_scene &scene, const dbk_ctx &ctx, dbk_real age,
                         dbk_real extra, bool known_only) {
  nb::dict d;
  std::unique_ptr<dbk_surround> s{new dbk_surround()};
  std::unique_ptr<dbk_nearby> near{new dbk_nearby()};
  dbk_surroundings(&model, &scene, age, extra, known_only, s.get());
  dbk_find_near(&model, &scene, &ctx, s.get(), near.get());
  REAL(*s, x), REAL(*s, y), REAL(*s, z), REAL(*s, margin), REAL(*s, alpha);
  put<uint32_t>(d, "parts", s->parts);
  WHOLE(*near, count);
  put<int16_t>(d, "index", near->index);
  return d;
}

}  // namespace

nb::dict Kernel::inside(double extra, bool known_only) const {
  nb::dict d;
  d["body"] = of_body(*model);
  d["scene"] = of_scene(*scene);
  d["motion"] = of_motion(ctx->motion);
  d["rows"] = of_rows(ctx->rows);
  d["step"] = of_step(*ctx);
  if (scene->n_obstacles > 0) {
    d["around"] = of_surroundings(*model, *scene, *ctx, in.scene_age, static_cast<dbk_real>(extra), known_only);
  }
  return d;
}

void Kernel::stain(int byte) {
  std::memset(ctx.get(), byte, sizeof *ctx);
  std::memset(other.get(), byte, sizeof *other);
  dbk_init(ctx.get());
  dbk_init(other.get());
}
