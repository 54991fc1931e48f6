// The Python module: the Kernel class, the dynamics of an arm, the constants of the build, the functions for unit tests
// and the testing library.
#include <nanobind/nanobind.h>

#include "kernel.h"

void import_numpy();                // step.cpp
void bind_dynamics(nb::module_ &m); // dynamics.cpp
void bind_units(nb::module_ &m);    // unit_access.cpp
void bind_testing(nb::module_ &m);  // testing_binding.cpp
void bind_control_loop(nb::module_ &m); // control_loop_binding.cpp

NB_MODULE(DBK_MODULE, m) {
  import_numpy();
  nb::set_leak_warnings(false); // a program that a person interrupts ends with objects that no exit of Python frees
  m.doc() = "The compiled safety kernel.";
  m.attr("real") = sizeof(dbk_real) == 4 ? "float32" : "float64";
  m.attr("source_hash") = DBK_HASH;
  m.attr("flags") = DBK_FLAGS;
  m.attr("max_rows") = DBK_MAX_ROWS;
  m.attr("max_joints") = DBK_MAX_DOF;
  m.attr("max_links") = DBK_MAX_LINKS;
  m.attr("max_pairs") = DBK_MAX_PAIRS;
  m.attr("max_obstacles") = DBK_MAX_OBSTACLES;
  m.attr("max_spheres") = DBK_MAX_SPHERES;
  m.attr("max_held") = DBK_MAX_HELD;
  m.attr("max_user") = DBK_MAX_USER;
  nb::class_<Kernel>(m, "Kernel")
      .def(nb::init<const nb::dict &>())
      .def("set_obstacles", &Kernel::set_obstacles)
      .def("clear_permits", &Kernel::clear_permits)
      .def("permit", &Kernel::permit)
      .def("limit_near", &Kernel::limit_near)
      .def("attach", &Kernel::attach)
      .def("constrain", &Kernel::constrain)
      .def("set_base_pose", &Kernel::set_base_pose)
      .def("reset", &Kernel::reset)
      .def("set_result_type", &Kernel::set_result_type)
      .def("step", &Kernel::step)
      .def("batch", &Kernel::batch)
      .def("project", &Kernel::project)
      .def("tool", &Kernel::tool)
      .def("spheres", &Kernel::spheres)
      .def("rows", &Kernel::rows)
      .def("box", &Kernel::box)
      .def("debug_readout", &Kernel::debug_readout)
      .def("fill_memory", &Kernel::fill_memory)
      .def("closed_loop", &Kernel::closed_loop)
      .def("handles",
           [](Kernel &k) {
             return nb::make_tuple(nb::capsule(k.model.get(), kBuild), nb::capsule(k.scene.get(), kBuild),
                                   nb::capsule(k.ctx.get(), kBuild));
           })
      .def("time_steps", &Kernel::time_steps);
  bind_dynamics(m);
  bind_units(m);
  bind_testing(m);
  bind_control_loop(m);
}
