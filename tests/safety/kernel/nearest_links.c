/* Two states run the same closed loop, with events: a new scene, a grasped object, a jump of the joints, another opening.
 * Before every step, ctx->nearest of the second state is replaced by arbitrary numbers. All results must have the same
 * bits. Prints the number of steps, the number of those that culled other pairs, and the hash of the results. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "closed_loop.c"

static dbk_ctx twin;
static dbk_out twin_out;

static void attach(int32_t count) {
  scene.n_held = count;
  for (int32_t s = 0; s < count; ++s) {
    scene.held_x[s] = between(-0.03f, 0.03f);
    scene.held_y[s] = between(-0.03f, 0.03f);
    scene.held_z[s] = between(0.1f, 0.16f);
    scene.held_r[s] = 0.02f;
  }
  scene.held_error = 0.002f;
}

static void cause_event(int32_t kind) {
  if (kind == 0) { place_obstacles((int32_t)(20 * chance())); }
  if (kind == 1) { attach(scene.n_held ? 0 : 3); }
  for (int32_t k = 0; kind == 2 && k < ROBOT_JOINTS; ++k) { in.q[k] = robot_home[k] + between(-0.4f, 0.4f); }
  if (kind == 3) { in.opening = between(0.0f, 0.04f); }
  dbk_scene_prepare(&scene);
}

static int32_t same(void) {
  const size_t bytes = (size_t)ctx.rows.count * sizeof(dbk_real);
  int32_t equal = memcmp(&out, &twin_out, sizeof out) == 0 && ctx.rows.count == twin.rows.count;
  for (int32_t k = 0; equal && k < ROBOT_JOINTS; ++k) { equal = memcmp(ctx.rows.a[k], twin.rows.a[k], bytes) == 0; }
  equal = equal && memcmp(ctx.rows.b, twin.rows.b, bytes) == 0 && memcmp(ctx.rows.h, twin.rows.h, bytes) == 0;
  return equal && memcmp(&ctx.revisits, &twin.revisits, sizeof ctx.revisits.count) == 0;
}

int main(int argc, char **argv) {
  const int32_t count = argc > 1 ? atoi(argv[1]) : 1000;
  int32_t differently = 0;
  loop_begin(8, 1);
  memcpy(&twin, &ctx, sizeof ctx);
  for (int32_t t = 0; t < count; ++t) {
    if (t % 23 == 22) { cause_event((int32_t)(4 * chance())); }
    loop_propose();
    twin.nearest.link_pair = (int32_t)between(-3.0f, 3.0f * ROBOT_PAIRS);
    twin.nearest.sphere = (int32_t)between(-9.0f, 2.0f * ROBOT_SPHERES);
    memset(&out, 0, sizeof out);
    memset(&twin_out, 0, sizeof twin_out);
    (void)loop_step();
    (void)dbk_step(&robot_model, &scene, &twin, &in, &twin_out);
    differently += ctx.narrow_phase_count != twin.narrow_phase_count;
    if (!same()) {
      printf("step %d: the results differ\n", (int)t);
      return 1;
    }
    loop_apply();
  }
  printf("%d %d %016llx\n", (int)count, (int)differently, (unsigned long long)loop_hash);
  return 0;
}
