// The numbers behind the flags of a step that stopped: which input, obstacle, joint or pair it was, its value and the
// limit. `dualbrain.safety.cbf.stop_cause` writes sentences from them.
#include <cmath>

#include "kernel.h"

extern "C" {
#include "model/dbk_scene.h"
}

namespace {

// kinds of an input value; `i` is the index in the array
enum { INPUT_Q, INPUT_V, INPUT_U_NOM, INPUT_OPENING, INPUT_BASE_ROTATION, INPUT_BASE_POSITION };
constexpr double kMaxOpening = 0.1;  // of input_flags in dbk_step.c

nb::tuple entry(int flag, int kind, int i, int j, double value, double limit) {
  return nb::make_tuple(flag, kind, i, j, value, limit);
}

// index of the first value that is not finite, or -1
int first_not_finite(const dbk_real *values, size_t count) {
  for (size_t i = 0; i < count; ++i) {
    if (!std::isfinite(values[i])) { return static_cast<int>(i); }
  }
  return -1;
}

nb::tuple bad_input(const dbk_in &in, size_t n, double opening, double largest_opening) {
  const struct {
    int kind;
    const dbk_real *values;
    size_t count;
  } arrays[] = {{INPUT_Q, in.q, n},
                {INPUT_V, in.v, n},
                {INPUT_U_NOM, in.u_nom, n},
                {INPUT_BASE_ROTATION, in.base_rotation, in.mobile ? size_t(9) : size_t(0)},
                {INPUT_BASE_POSITION, in.base_position, in.mobile ? size_t(3) : size_t(0)}};
  for (const auto &array : arrays) {
    const int at = first_not_finite(array.values, array.count);
    if (at >= 0) { return entry(DBK_BAD_INPUT, array.kind, at, 0, double(array.values[at]), INFINITY); }
  }
  return entry(DBK_BAD_INPUT, INPUT_OPENING, 0, 0, opening, largest_opening);
}

// the joint that is farthest outside its limits
nb::tuple outside(const dbk_model &model, const dbk_in &in) {
  int worst = 0;
  double value = 0.0, limit = 0.0, most = -1.0;
  for (int k = 0; k < model.n; ++k) {
    const double y = double(in.q[k] + model.lag * in.v[k]), low = double(model.q_lower[k]),
                 high = double(model.q_upper[k]), excess = y > high ? y - high : low - y;
    if (excess > most) {
      worst = k;
      value = y;
      limit = y > high ? high : low;
      most = excess;
    }
  }
  return entry(DBK_OUTSIDE, 0, worst, 0, value, limit);
}

}  // namespace

nb::object Kernel::stop_evidence() const {
  nb::list all;
  const int32_t flags = out.flags;
  const dbk_rows &rows = ctx->rows;
  if (flags & DBK_BAD_INPUT) { all.append(bad_input(in, n, given_opening, hull_model ? opening_max : kMaxOpening)); }
  if (flags & DBK_BAD_SCENE) {
    all.append(entry(DBK_BAD_SCENE, 0, dbk_first_invalid_obstacle(scene.get()), 0, 0.0, 0.0));
  }
  if (flags & DBK_STALE_STATE) {
    all.append(entry(DBK_STALE_STATE, 0, 0, 0, double(in.state_age), double(model->state_age_max)));
  }
  if (flags & DBK_STALE_SCENE) {
    all.append(entry(DBK_STALE_SCENE, 0, 0, 0, double(in.scene_age), double(model->scene_age_max)));
  }
  if (flags & DBK_OUTSIDE) { all.append(outside(*model, in)); }
  if (flags & DBK_ROW_OVERFLOW) {
    all.append(entry(DBK_ROW_OVERFLOW, 0, ctx->revisits.count, DBK_MAX_REVISITS, rows.count, DBK_MAX_ROWS));
  }
  if (flags & (DBK_NO_GRADIENT | DBK_UNAVOIDABLE)) {
    const int flag = flags & DBK_NO_GRADIENT ? DBK_NO_GRADIENT : DBK_UNAVOIDABLE;
    all.append(entry(flag, rows.fixed_kind, rows.fixed_i, rows.fixed_j, double(rows.fixed_h), 0.0));
  }
  if (flags & DBK_QP_ITERATIONS) {
    all.append(entry(DBK_QP_ITERATIONS, 0, 0, 0, out.iterations, DBK_QP_MAX_ITERATIONS));
  }
  if (flags & DBK_UNCERTIFIED) {
    const dbk_rejected_pair &pair = ctx->rejected_pair;
    all.append(entry(DBK_UNCERTIFIED, pair.kind, pair.i, pair.j, double(pair.h), double(pair.next)));
  }
  return nb::tuple(all);
}
