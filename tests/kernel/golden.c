/* Ten closed loops of one thousand steps each; prints an FNV-1a hash over every bit of every answer. */
#include <stdio.h>

#include "arm.h"

static dbk_model model;
static dbk_scene scene;
static dbk_ctx ctx;

static uint64_t mix(uint64_t hash, const void *data, size_t size) {
  const unsigned char *byte = data;
  for (size_t i = 0; i < size; ++i) { hash = (hash ^ byte[i]) * 1099511628211u; }
  return hash;
}

int main(void) {
  uint64_t hash = 1469598103934665603u;
  long count[5] = {0};
  arm_model(&model);
  for (uint64_t run = 0; run < 10; ++run) {
    uint64_t state = run * 7919 + 1;
    arm_scene(&scene, &state, 8);
    if (run % 2) {
      scene.n_held = 2;
      for (int s = 0; s < 2; ++s) {
        scene.held_x[s] = scene.held_y[s] = 0;
        scene.held_z[s] = (dbk_real)(0.24 + 0.03 * s);
        scene.held_r[s] = (dbk_real)0.03;
      }
      dbk_scene_prepare(&scene);
    }
    dbk_init(&ctx);
    static const double home[7] = {0, -0.3, 0, -2.2, 0, 2.0, 0.785};
    dbk_in in;
    dbk_out out;
    memset(&in, 0, sizeof in);
    for (int k = 0; k < 7; ++k) { in.q[k] = (dbk_real)home[k]; }
    in.opening = (dbk_real)0.02;
    for (int t = 0; t < 1000; ++t) {
      if (t % 100 == 0) {
        for (int k = 0; k < 7; ++k) { in.u_nom[k] = between(&state, -2.2, 2.2); }
      }
      in.scene_age = (dbk_real)(0.0003 * t);
      dbk_step(&model, &scene, &ctx, &in, &out);
      hash = mix(hash, out.u, sizeof out.u);
      hash = mix(hash, &out.delta, sizeof out.delta);
      hash = mix(hash, &out.h_min, sizeof out.h_min);
      hash = mix(hash, &out.status, sizeof out.status);
      hash = mix(hash, &out.iterations, sizeof out.iterations);
      ++count[out.status];
      for (int k = 0; k < 7; ++k) {
        in.v[k] = in.v[k] + (out.u[k] - in.v[k]) * (dbk_real)0.05;
        in.q[k] += model.period * in.v[k];
      }
    }
  }
  printf("%016llx %ld %ld %ld %ld %ld\n", (unsigned long long)hash, count[0], count[1], count[2], count[3], count[4]);
  return 0;
}
