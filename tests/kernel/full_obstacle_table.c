/* The maximum number of obstacles, all close to the hand: the batched rows of one sphere cover all of them. */
#include <stdio.h>

#include "arm.h"

static dbk_model model;
static dbk_scene scene;
static dbk_ctx ctx;

static void crowd(uint64_t *state, const dbk_real place[3]) {
  arm_scene(&scene, state, DBK_MAX_OBSTACLES);
  for (int o = 0; o < DBK_MAX_OBSTACLES; ++o) {
    dbk_obstacle *ob = &scene.obstacle[o];
    ob->shape = DBK_CAPSULE;
    ob->half[0] = ob->half[1] = ob->half[2] = ob->radius = (dbk_real)0.01;
    for (int e = 0; e < 3; ++e) { ob->position[e] = place[e] + random_between(state, -0.15, 0.15); }
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
    for (int k = 0; k < model.n; ++k) { in.u_nom[k] = random_between(&state, -1.0, 1.0); }
    if (t % 20 == 0) {
      const dbk_real place[3] = {ctx.spheres.x[model.n_spheres - 1], ctx.spheres.y[model.n_spheres - 1],
                                 ctx.spheres.z[model.n_spheres - 1]};
      crowd(&state, place);
    }
    in.opening = (dbk_real)0.02;
    dbk_step(&model, &scene, &ctx, &in, &out);
    rows += ctx.rows.count;
  }
  printf("%ld\n", rows);
  return 0;
}
