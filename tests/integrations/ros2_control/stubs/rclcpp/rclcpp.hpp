// Stub of the parts of rclcpp that the controller uses; written for dualbrain's test, not taken from ROS.
#ifndef STUB_RCLCPP_HPP_
#define STUB_RCLCPP_HPP_

#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>
#include <vector>

namespace rclcpp {

class Time {};
class Duration {};
class Logger {};

using Value = std::variant<std::string, std::vector<std::string>>;

class Parameter {
 public:
  explicit Parameter(Value value) : value_(std::move(value)) {}
  std::string as_string() const { return std::get<std::string>(value_); }
  std::vector<std::string> as_string_array() const { return std::get<std::vector<std::string>>(value_); }

 private:
  Value value_;
};

// a node with parameters that must be declared before they are read
class Node {
 public:
  void override_parameter(const std::string &name, Value value) { overrides_[name] = std::move(value); }
  void declare(const std::string &name, Value value) {
    declared_[name] = overrides_.count(name) ? overrides_[name] : std::move(value);
  }
  Parameter get_parameter(const std::string &name) const {
    const auto found = declared_.find(name);
    if (found == declared_.end()) { throw std::invalid_argument("parameter " + name + " is not declared"); }
    return Parameter(found->second);
  }
  const char *get_name() const { return "safety_filter"; }
  Logger get_logger() const { return Logger(); }

 private:
  std::map<std::string, Value> declared_, overrides_;
};

}  // namespace rclcpp

#endif
