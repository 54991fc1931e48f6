/* As many things as there is room for, all of them near the hand: one sphere meets all of them at once. */
#include <stdio.h>

#include "arm.h"

static dbk_model model;
static dbk_scene scene;
static dbk_ctx ctx;

static void crowd(uint64_t *state, const dbk_real place[3]) {
  arm_scene(&scene, state, DBK_MAX_OBSTACLES);
  for (int o = 0; o < DBK_MAX_OBSTACLES; ++o) {
    dbk_obstacle *it = &scene.obstacle[o];
    it->shape = DBK_CAPSULE;
    it->half[0] = it->half[1] = it->half[2] = it->radius = (dbk_real)0.01;
    for (int e = 0; e < 3; ++e) { it->position[e] = place[e] + between(state, -0.15, 0.15); }
  }
  dbk_scene_prepare(&scene);
}

int main(void) {
  uint64_t state = 7;
  long rows = 0;
  arm_model(&model);
  dbk_init(&ctx);
  for (int t = 0; t < 200; ++t) {
    dbk_in in;
    dbk_out out;
    memset(&in, 0, sizeof in);
    for (int k = 0; k < model.n; ++k) { in.u_nom[k] = between(&state, -1.0, 1.0); }
    if (t % 20 == 0) {
      const dbk_real place[3] = {ctx.cloud.x[model.n_spheres - 1], ctx.cloud.y[model.n_spheres - 1], ctx.cloud.z[model.n_spheres - 1]};
      crowd(&state, place);
    }
    in.opening = (dbk_real)0.02;
    dbk_step(&model, &scene, &ctx, &in, &out);
    rows += ctx.rows.count;
  }
  printf("%ld\n", rows);
  return 0;
}
