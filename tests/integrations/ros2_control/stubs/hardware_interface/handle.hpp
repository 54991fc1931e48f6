// Stubs of the handles of ros2_control (Jazzy and later) that the controller uses.
#ifndef STUB_HARDWARE_INTERFACE_HANDLE_HPP_
#define STUB_HARDWARE_INTERFACE_HANDLE_HPP_

#include <optional>
#include <string>
#include <utility>

namespace hardware_interface {

class CommandInterface {
 public:
  CommandInterface(std::string prefix, std::string name, double *value)
      : prefix_(std::move(prefix)), name_(std::move(name)), value_(value) {}
  std::string get_name() const { return prefix_ + "/" + name_; }
  void set(double value) { *value_ = value; }

 private:
  std::string prefix_, name_;
  double *value_;
};

class LoanedStateInterface {
 public:
  std::optional<double> get_optional() const { return value; }
  std::optional<double> value;  // none: another thread holds it
};

class LoanedCommandInterface {
 public:
  [[nodiscard]] bool set_value(double given) {
    if (!locked) { value = given; }
    return !locked;
  }
  double value = 0.0;
  bool locked = false;
};

}  // namespace hardware_interface

#endif
