/* Arbitrary bits in every input: the result is always finite and within the velocity and acceleration bounds. */
#include <stdio.h>
#include <stdlib.h>

#include "arm.h"

static dbk_model model;
static dbk_scene scene;
static dbk_ctx ctx;

/* a plausible number, or with a small probability an arbitrary bit pattern, infinity or a very large number */
static dbk_real random_value(uint64_t *state, double size) {
  const double pick = random_uniform(state);
  dbk_real value = random_between(state, -size, size);
  if (pick < 0.02) {
    const uint64_t bits =
        ((uint64_t)(random_uniform(state) * 4294967296.0) << 32) | (uint64_t)(random_uniform(state) * 4294967296.0);
    memcpy(&value, &bits, sizeof value);
  } else if (pick < 0.03) {
    value = (dbk_real)1e30 * (dbk_real)1e30;
  } else if (pick < 0.04) {
    value = (dbk_real)(size * 1e6);
  }
  return value;
}

static int admissible(const dbk_real before[DBK_MAX_DOF], const dbk_out *out) {
  for (int k = 0; k < model.n; ++k) {
    const double u = (double)out->u[k], step = (double)model.a_max[k] * (double)model.period * 1.00001 + 1e-6;
    if (!(u >= -(double)model.v_max[k] && u <= (double)model.v_max[k])) { return 0; }
    if (!(u >= (double)before[k] - step && u <= (double)before[k] + step)) { return 0; }
  }
  return out->delta >= 0 && out->delta <= 2 && out->delta_rows >= 0 && out->delta_box >= 0 &&
         (out->h_min - out->h_min == 0 || out->status == DBK_STOPPED);
}

int main(int argc, char **argv) {
  const long steps = argc > 1 ? atol(argv[1]) : 20000;
  uint64_t state = 12345;
  long count[5] = {0};
  arm_model(&model);
  dbk_init(&ctx);
  for (long t = 0; t < steps; ++t) {
    dbk_in in;
    dbk_out out;
    dbk_real before[DBK_MAX_DOF], projected[DBK_MAX_DOF];
    memset(&in, 0, sizeof in);
    if (t % 50 == 0) {
      arm_scene(&scene, &state, (int)(random_uniform(&state) * 48.9));
      if (random_uniform(&state) < 0.2) { scene.obstacle[0].position[2] = random_value(&state, 1.0); }
      scene.n_held = (int32_t)(random_uniform(&state) * 8.9);
      for (int s = 0; s < scene.n_held; ++s) {
        scene.held_x[s] = scene.held_y[s] = random_between(&state, -0.05, 0.05);
        scene.held_z[s] = random_between(&state, 0.15, 0.3);
        scene.held_r[s] = random_between(&state, 0.0, 0.05);
      }
      for (int p = 0; p < 5; ++p) {
        scene.permit[(int)(random_uniform(&state) * 8.9)][(int)(random_uniform(&state) * 47)] =
            random_between(&state, 0.0, 0.1);
      }
      dbk_scene_prepare(&scene);
    }
    for (int k = 0; k < model.n; ++k) {
      in.q[k] = random_uniform(&state) < 0.002
                    ? random_value(&state, 3.0)
                    : random_between(&state, (double)model.q_lower[k], (double)model.q_upper[k]);
      in.v[k] = random_uniform(&state) < 0.002 ? random_value(&state, 2.0) : random_between(&state, -1.0, 1.0);
      in.u_nom[k] = random_uniform(&state) < 0.01 ? random_value(&state, 2.5) : random_between(&state, -2.5, 2.5);
    }
    in.opening = random_uniform(&state) < 0.01 ? random_value(&state, 0.04) : (dbk_real)0.02;
    in.state_age = random_uniform(&state) < 0.01 ? random_value(&state, 0.1) : (dbk_real)0.001;
    in.scene_age = random_uniform(&state) < 0.01 ? random_value(&state, 1.0) : (dbk_real)0.01;
    memcpy(before, ctx.u_prev, sizeof before);
    dbk_step(&model, &scene, &ctx, &in, &out);
    ++count[out.status];
    if (!admissible(before, &out)) {
      printf("step %ld: inadmissible, status %d flags %d\n", t, out.status, out.flags);
      return 1;
    }
    if (out.status >= DBK_STOPPED && !(out.flags & ~DBK_JERK)) {
      printf("step %ld: status %d without a cause\n", t, out.status);
      return 1;
    }
    dbk_project(&model, &scene, &ctx, &in, before, (dbk_real)5e-4, projected);
    for (int k = 0; k < model.n; ++k) {
      if (!(projected[k] >= -model.v_max[k] && projected[k] <= model.v_max[k])) {
        printf("step %ld: projection outside\n", t);
        return 1;
      }
    }
  }
  printf("%ld %ld %ld %ld %ld\n", count[0], count[1], count[2], count[3], count[4]);
  return 0;
}
