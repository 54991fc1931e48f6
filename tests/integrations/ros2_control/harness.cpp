// Runs the controller against the stubs: harness TABLES UPDATE_RATE [JOINT ...] reads lines from stdin and prints the
// commands of each step as hexadecimal floats.
//
//   activate q... v...    activates the controller at this state, in the chained mode
//   chain 0|1             leaves or enters the chained mode
//   lock 0|1              the command interfaces refuse values
//   lose                  the state interfaces have no value in the next step
//   step q... v... r...   one update
#include <cmath>
#include <cstdio>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

#include "dualbrain_ros2_control/safety_filter_controller.hpp"

using dualbrain_ros2_control::SafetyFilterController;

static double take(std::istringstream &line) {
  std::string word;
  line >> word;
  return std::stod(word);  // also nan and inf
}

static void set_state(SafetyFilterController &controller, std::istringstream &line) {
  for (auto &interface : controller.state_interfaces_) { interface.value = take(line); }
}

int main(int count, char **arguments) {
  SafetyFilterController controller;
  controller.update_rate = static_cast<unsigned int>(std::stoul(arguments[2]));
  controller.get_node()->override_parameter("tables", std::string(arguments[1]));
  controller.get_node()->override_parameter("joints", std::vector<std::string>(arguments + 3, arguments + count));
  if (controller.on_init() != controller_interface::CallbackReturn::SUCCESS) { return 2; }
  if (controller.on_configure({}) != controller_interface::CallbackReturn::SUCCESS) { return 3; }
  controller.claim();
  for (const auto &name : controller.command_interface_configuration().names) { std::printf("%s ", name.c_str()); }
  for (const auto &name : controller.state_interface_configuration().names) { std::printf("%s ", name.c_str()); }
  for (const auto &reference : controller.exported) { std::printf("%s ", reference.get_name().c_str()); }
  std::printf("\n");
  std::string text, word;
  bool lost = false;
  while (std::getline(std::cin, text)) {
    std::istringstream line(text);
    if (!(line >> word)) { continue; }
    if (word == "activate") {
      set_state(controller, line);
      controller.set_chained_mode(true);
      if (controller.on_activate({}) != controller_interface::CallbackReturn::SUCCESS) { return 4; }
    } else if (word == "chain") {
      controller.set_chained_mode(take(line) != 0.0);
    } else if (word == "lock") {
      const bool locked = take(line) != 0.0;
      for (auto &interface : controller.command_interfaces_) { interface.locked = locked; }
    } else if (word == "lose") {
      lost = true;
    } else {
      set_state(controller, line);
      for (auto &reference : controller.exported) { reference.set(take(line)); }
      if (lost) {
        for (auto &interface : controller.state_interfaces_) { interface.value.reset(); }
      }
      lost = false;
      const auto result = controller.update({}, {});
      std::printf("%d", result == controller_interface::return_type::OK);
      for (const auto &interface : controller.command_interfaces_) { std::printf(" %a", interface.value); }
      std::printf("\n");
    }
  }
  const bool stopped = controller.on_deactivate({}) == controller_interface::CallbackReturn::SUCCESS;
  std::printf("%d", stopped);
  for (const auto &interface : controller.command_interfaces_) { std::printf(" %a", interface.value); }
  std::printf("\n");
  return 0;
}
