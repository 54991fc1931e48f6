/* Frama-C Eva: a loop of complete steps of an exported robot with arbitrary bits in every input. */
#include "closed_loop.c"

#include "arbitrary.h"

int main(void) {
  loop_begin(0, 1);
  while (arbitrary_word) {
    fill_arbitrary(in.q, DBK_MAX_DOF);
    fill_arbitrary(in.v, DBK_MAX_DOF);
    fill_arbitrary(in.u_nom, DBK_MAX_DOF);
    fill_arbitrary(in.base_rotation, 9);
    fill_arbitrary(in.base_position, 3);
    in.opening = arbitrary_real();
    in.state_age = arbitrary_real();
    in.scene_age = arbitrary_real();
    in.mobile = (int32_t)(arbitrary_word & 1u);
    (void)loop_step();
    for (int32_t k = 0; k < ROBOT_JOINTS; ++k) {
      /*@ assert \is_finite(out.u[k]) && -3 <= out.u[k] <= 3; */
    }
  }
  return 0;
}
