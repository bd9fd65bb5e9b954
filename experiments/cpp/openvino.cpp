// Run an exported scorer in OpenVINO, and compare its outputs with those in the folder.
//
//     scorer_openvino FOLDER [TOLERANCE]
//
// Prints the scores and the largest difference. Exits with 1 if the difference is above the tolerance.

#include <openvino/openvino.hpp>

#include "arrays.h"

float run(const std::string& folder) {
  ov::Core core;
  auto model = core.compile_model(folder + "/program.onnx", "CPU", ov::hint::inference_precision(ov::element::f32),
                                  ov::hint::execution_mode(ov::hint::ExecutionMode::ACCURACY));
  auto request = model.create_infer_request();
  std::vector<std::vector<char>> arrays;  // the tensors use their memory
  for (const auto& input : model.inputs()) {
    arrays.push_back(read_array(folder + "/check/" + input.get_any_name() + ".npy"));
    const ov::Tensor tensor(input.get_element_type(), input.get_shape(), arrays.back().data());
    if (tensor.get_byte_size() != arrays.back().size())
      throw std::runtime_error(input.get_any_name() + ": expected as many numbers as in the model");
    request.set_tensor(input, tensor);
  }
  request.infer();
  float largest = 0;
  for (const auto& output : model.outputs()) {
    const ov::Tensor tensor = request.get_tensor(output);
    largest = std::max(largest, compare(folder, output.get_any_name(), tensor.data<float>(), tensor.get_size()));
  }
  return largest;
}

int main(int argc, char** argv) { return run_example(argc, argv, run); }
