/* Frama-C Eva: a loop of complete steps of an exported robot with arbitrary bits in every input and in every field of
 * the scene. Eva does not relate the check of the numbers of obstacles, held spheres and rows to their values; numbers
 * outside of their bounds therefore have their own branch, with the assertion that the scene is refused. */
#include "closed_loop.c"

#include "arbitrary.h"

static int32_t arbitrary_integer(void) { return (int32_t)arbitrary_word; }

static void arbitrary_obstacle(dbk_obstacle *o) {
  o->shape = arbitrary_integer();
  o->flags = arbitrary_integer();
  o->rank = arbitrary_integer();
  o->link_mask = arbitrary_word;
  o->alpha = arbitrary_real();
  fill_arbitrary(o->position, 3);
  fill_arbitrary(o->rotation, 9);
  fill_arbitrary(o->half, 3);
  o->radius = arbitrary_real();
  fill_arbitrary(o->velocity, 3);
  o->margin = arbitrary_real();
  o->velocity_error = arbitrary_real();
  o->reaction = arbitrary_real();
  o->brake = arbitrary_real();
  o->approach = arbitrary_real();
  o->near_speed = arbitrary_real();
  o->near_distance = arbitrary_real();
  o->near_brake = arbitrary_real();
  o->near_approach = arbitrary_real();
}

static void arbitrary_scene(void) {
  scene.n_obstacles = arbitrary_integer();
  scene.n_held = arbitrary_integer();
  scene.n_user = arbitrary_integer();
  scene.held_error = arbitrary_real();
  for (int32_t o = 0; o < DBK_MAX_OBSTACLES; ++o) { arbitrary_obstacle(&scene.obstacle[o]); }
  for (int32_t l = 0; l < DBK_ALL_LINKS; ++l) {
    for (int32_t o = 0; o < DBK_MAX_OBSTACLES; ++o) { scene.permit[l][o] = arbitrary_real(); }
  }
  for (int32_t s = 0; s < DBK_MAX_HELD; ++s) {
    scene.held_x[s] = arbitrary_real();
    scene.held_y[s] = arbitrary_real();
    scene.held_z[s] = arbitrary_real();
    scene.held_r[s] = arbitrary_real();
  }
  for (int32_t r = 0; r < DBK_MAX_USER; ++r) {
    fill_arbitrary(scene.user_a[r], DBK_MAX_DOF);
    scene.user_b[r] = arbitrary_real();
    scene.user_h[r] = arbitrary_real();
    scene.user_rank[r] = arbitrary_integer();
  }
}

static void arbitrary_input(void) {
  fill_arbitrary(in.q, DBK_MAX_DOF);
  fill_arbitrary(in.v, DBK_MAX_DOF);
  fill_arbitrary(in.u_nom, DBK_MAX_DOF);
  fill_arbitrary(in.base_rotation, 9);
  fill_arbitrary(in.base_position, 3);
  in.opening = arbitrary_real();
  in.state_age = arbitrary_real();
  in.scene_age = arbitrary_real();
  in.mobile = (int32_t)(arbitrary_word & 1u);
}

static void checked_step(void) {
  (void)loop_step();
  for (int32_t k = 0; k < ROBOT_JOINTS; ++k) {
    /*@ assert \is_finite(out.u[k]) && -3 <= out.u[k] <= 3; */
  }
}

static int32_t within(int32_t most) { return dbk_bounded(arbitrary_integer(), most); }

static int32_t below_zero(void) { return (int32_t)(arbitrary_word | 0x80000000u); }

static int32_t above(int32_t most) { return most + 1 + (int32_t)(arbitrary_word & 0xFFFFFFFu); }

/* the scene is refused */
static void prepare_invalid(void) {
  dbk_scene_prepare(&scene);
  /*@ assert scene.ready == 0; */
}

/* a number of obstacles, of held spheres or of rows that is too small or too large */
static void invalid_number(void) {
  const uint32_t which = arbitrary_word;
  if (which == 0) {
    scene.n_obstacles = below_zero();
    prepare_invalid();
  } else if (which == 1) {
    scene.n_obstacles = above(DBK_MAX_OBSTACLES);
    prepare_invalid();
  } else if (which == 2) {
    scene.n_held = below_zero();
    prepare_invalid();
  } else if (which == 3) {
    scene.n_held = above(DBK_MAX_HELD);
    prepare_invalid();
  } else if (which == 4) {
    scene.n_user = below_zero();
    prepare_invalid();
  } else {
    scene.n_user = above(DBK_MAX_USER);
    prepare_invalid();
  }
}

int main(void) {
  /* thresholds at which Eva tries to stop the growth of a number in a loop */
  /*@ widen_hints global:"all", 8, 16, 20, 21, 64, 65, 112, 120, 121, 128, 129; */
  loop_begin(0, 1);
  while (arbitrary_word) {
    arbitrary_scene();
    arbitrary_input();
    scene.n_obstacles = within(DBK_MAX_OBSTACLES);
    scene.n_held = within(DBK_MAX_HELD);
    scene.n_user = within(DBK_MAX_USER);
    if (arbitrary_word) {
      dbk_scene_prepare(&scene);
      checked_step();
    } else {
      invalid_number();
      checked_step();
    }
  }
  return 0;
}
