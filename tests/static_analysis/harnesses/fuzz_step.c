/* libFuzzer: sequences of steps, scenes and grasps from arbitrary bytes. The control is always finite and within the
 * velocity limits, a rejected input stops the robot, and the intervention is between 0 and 2. */
#include <stdlib.h>
#include <string.h>

#include "closed_loop.c"

typedef struct {
  const uint8_t *at;
  size_t left;
} bytes;

static void take(bytes *from, void *to, size_t count) {
  const size_t n = count < from->left ? count : from->left;
  memset(to, 0, count);
  memcpy(to, from->at, n);
  from->at += n;
  from->left -= n;
}

/* arbitrary bits, or an offset from a plausible value */
static void take_real(bytes *from, uint8_t raw, dbk_real plausible, dbk_real *to) {
  int8_t offset;
  if (raw) {
    take(from, to, sizeof *to);
  } else {
    take(from, &offset, 1);
    *to = plausible + (dbk_real)offset * 0.002f;
  }
}

static void check(void) {
  int32_t valid = out.status >= DBK_SAFE && out.status <= DBK_FAULT && out.delta >= 0.0f && out.delta <= 2.0f;
  for (int32_t k = 0; k < ROBOT_JOINTS; ++k) {
    valid = valid && out.u[k] >= -robot_model.v_max[k] && out.u[k] <= robot_model.v_max[k];
    if (out.flags & (DBK_BAD_INPUT | DBK_BAD_SCENE)) { valid = valid && out.status == DBK_STOPPED; }
  }
  if (!valid) { abort(); }
}

static void change_scene(bytes *from) {
  take(from, &random_state, sizeof random_state);
  place_obstacles((int32_t)(random_state & 7u));
  scene.n_held = (int32_t)(random_state >> 8 & 3u);
  for (int32_t s = 0; s < scene.n_held; ++s) {
    scene.held_z[s] = between(0.08f, 0.2f);
    scene.held_r[s] = 0.02f;
  }
  if (random_state >> 16 & 1u && scene.n_obstacles > 0) { take(from, &scene.obstacle[0].position, 12); }
  dbk_scene_prepare(&scene);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
  bytes from = {data, size};
  loop_begin(3, 1);
  while (from.left > 0) {
    uint8_t raw[4];
    take(&from, raw, sizeof raw);
    if (raw[3] > 200) { change_scene(&from); }
    for (int32_t k = 0; k < ROBOT_JOINTS; ++k) {
      take_real(&from, raw[0] > 250, in.q[k], &in.q[k]);
      take_real(&from, raw[1] > 240, ctx.u_prev[k], &in.v[k]);
      take_real(&from, raw[1] > 230, raw[2] > 128 ? robot_model.v_max[k] : -robot_model.v_max[k], &in.u_nom[k]);
    }
    take_real(&from, raw[2] > 250, 0.02f, &in.opening);
    take_real(&from, raw[2] > 252, 0.0f, &in.state_age);
    (void)loop_step();
    check();
    for (int32_t k = 0; k < ROBOT_JOINTS; ++k) {
      const dbk_real q = in.q[k] + robot_model.period * out.u[k];
      in.q[k] = q > -4.0f && q < 4.0f ? q : robot_home[k]; /* also without arbitrary bits */
    }
  }
  return 0;
}
